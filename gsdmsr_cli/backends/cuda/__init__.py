"""Compiles kernels in CUDA C at run time and launches them on torch's tensors."""
