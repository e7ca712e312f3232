"""Renders the views of a training step and takes their gradients, in one process or several."""
