"""A small moving scene, ray-traced."""
