"""The kernels of drawing for GPUs, and what launches them."""
