"""Writes the results of an evaluation as one HTML file that needs no other files."""
