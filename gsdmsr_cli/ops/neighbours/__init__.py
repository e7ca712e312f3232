"""The nearest neighbours of points among themselves."""
