"""Kernels in CUDA C: compiled at run time, launched on torch's tensors and current stream."""
