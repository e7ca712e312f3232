"""Trains a capture moment after moment, each from the one before.

The first moment is an ordinary training of its own pictures, in which splats grow and nothing
moves. From then on the splats stay what they are; at each moment the motion ``tracks`` learns where
they are and how they are turned (Dynamic 3D Gaussians, Luiten et al., 3DV 2024). What a moment has
learnt is written as a small file of the run folder as it ends (``runs.moments``).
"""
