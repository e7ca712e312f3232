"""The splats that a training starts from."""
