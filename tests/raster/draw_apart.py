"""Draws a few cases with the CPU engine into an .npz file; run as a process of its own.

What is compared depends on the environment: NUMBA_NUM_THREADS or NUMBA_CPU_NAME.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from raster_scenes import case, draw, pixel_weights

NAMES = ("1x1", "50x37", "64x48", "more than a batch in a tile", "sh degree 3")


def drawn() -> dict[str, np.ndarray]:
    """Return frames and gradients of the cases, by case and tensor."""
    from gsdmsr_cli.raster import cpu

    found = {}
    for name in NAMES:
        drawing = draw(cpu, case(name), pixel_weights(case(name)), "cpu", torch.float32)
        frame = {n: t for n, t in vars(drawing.frame).items() if t is not None}
        gradients = {f"d_{n}": t for n, t in drawing.gradients.items()}
        found |= {f"{name}/{n}": t.numpy() for n, t in (frame | gradients).items()}
    return found


def main() -> None:
    """Write ``drawn()`` and what numba compiles for to the file that is named first."""
    import numba
    from numba.core.registry import cpu_target

    from gsdmsr_cli.backends.cpu import jit

    numbers = drawn()
    target = " ".join(cpu_target.target_context.codegen().magic_tuple())
    threads = np.array([numba.config.NUMBA_NUM_THREADS, jit.threads()])
    np.savez(Path(sys.argv[1]), target=np.array(target), threads=threads, **numbers)


if __name__ == "__main__":
    main()
