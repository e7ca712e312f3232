"""One folder per operation: what it computes, its kernels for CPU and GPU, and a twin in torch."""
