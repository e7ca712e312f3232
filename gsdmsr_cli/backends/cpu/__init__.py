"""Compiles Numba kernels, and gives them vectors of 16 floats."""
