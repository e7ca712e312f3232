"""The kernels of drawing for the CPU, one file per stage."""
