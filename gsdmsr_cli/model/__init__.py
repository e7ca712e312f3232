"""The model of a scene: canonical splats and the layers that they go through."""
