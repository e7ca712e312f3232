"""Scores, speed and storage of a trained run."""
