"""gsdmsr: dynamic Gaussian splatting from images or video, on a CPU or a GPU."""

import os

__version__ = "0.2.0"

# Where OpenMP runs the kernels its threads must not spin between them: on few cores they starve
# each other (8 ms a launch instead of 0.04 on two). The runtime reads this once, when it is loaded.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
