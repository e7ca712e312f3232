"""gsdmsr: dynamic Gaussian splatting from images or video, on a CPU or a GPU."""

import os

__version__ = "0.1.0"

# Threads of torch's and Numba's OpenMP that spin between kernels starve each other on few cores
# (8 ms a launch instead of 0.04 on two); the runtime reads this once, before its first use.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
