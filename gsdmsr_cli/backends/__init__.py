"""Compiles and runs kernels on the CPU and on GPUs, whatever they compute."""
