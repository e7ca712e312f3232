"""Numba kernels on plain arrays, free of torch: the CPU engine, fields, losses and optimiser."""
