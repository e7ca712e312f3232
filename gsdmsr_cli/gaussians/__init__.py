"""Splats, what is drawn of them at an instant, and the picture that an engine makes."""
