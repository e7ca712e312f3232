"""Draws pictures and optical flow of a model."""
