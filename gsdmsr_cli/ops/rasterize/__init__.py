"""Kernels that draw splats: projection, colours, tiles, blending; and their gradients."""
