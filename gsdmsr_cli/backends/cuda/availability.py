"""Whether kernels can be compiled and run here, and if not, why; and on what."""

from __future__ import annotations

from typing import Any

import torch

from gsdmsr_cli.backends.cuda.compiler import OLDEST
from gsdmsr_cli.backends.cuda.driver import built_for
from gsdmsr_cli.backends.cuda.nvrtc import load_nvrtc


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


def describe() -> dict[str, Any]:
    """Return what there is, fit for JSON, with null for what is not there.

    "cuda" is the version that torch is built for, "nvrtc" that of the compiler, "name",
    "memory_mib" and "capability" are the GPU's, and "missing" is ``missing()``.
    """
    found: dict[str, Any] = dict.fromkeys(("name", "memory_mib", "capability"))
    if torch.cuda.is_available():
        card = torch.cuda.get_device_properties(torch.cuda.current_device())
        found["name"], found["memory_mib"] = card.name, card.total_memory >> 20
        found["capability"] = f"{card.major}.{card.minor}"
    nvrtc = load_nvrtc(built_for())
    version = None if nvrtc is None else f"{nvrtc.version[0]}.{nvrtc.version[1]}"
    return {"cuda": torch.version.cuda, "nvrtc": version, **found, "missing": missing()}


def usage(device: str) -> dict[str, Any]:
    """Return the GPU's name and the most memory its tensors have taken [MiB], None on the CPU."""
    if device == "cpu":
        return {"gpu": None, "peak_gpu_mib": None}
    peak = torch.cuda.max_memory_allocated() / (1 << 20)
    return {"gpu": torch.cuda.get_device_name(), "peak_gpu_mib": round(peak, 1)}
