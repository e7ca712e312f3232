"""Whether kernels can be compiled and run here, and if not, why."""

from __future__ import annotations

import torch

from gsdmsr_cli.cuda.compiler import OLDEST
from gsdmsr_cli.cuda.driver import built_for
from gsdmsr_cli.cuda.nvrtc import load_nvrtc


def missing() -> str | None:
    """Return what CUDA kernels lack on this machine, one clause with the remedy, or None."""
    major = built_for()
    if major is None:
        return (
            f"torch {torch.__version__} is built without CUDA; install a build with CUDA "
            "(pytorch.org/get-started) and gsdmsr[cuda]"
        )
    if not torch.cuda.is_available():
        return "torch finds no NVIDIA GPU; is there one, and a driver for it (nvidia-smi)?"
    capability = torch.cuda.get_device_capability()
    if 10 * capability[0] + capability[1] < OLDEST:
        return (
            f"the GPU's compute capability is {capability[0]}.{capability[1]}, and "
            f"{OLDEST // 10}.{OLDEST % 10} is the least that is supported"
        )
    if load_nvrtc(major) is None:
        return f"NVRTC of CUDA {major} is missing; pip install 'gsdmsr[cuda]' brings it"
    return None
