"""Measures a trained run: image quality, speed and storage."""
