"""Loads a folder of other kernels (``iter.py`` and its modules) and feeds them the same splats."""

from __future__ import annotations

import importlib
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gsdmsr_cli.benchmark.cloud import camera, cloud
from gsdmsr_cli.benchmark.workloads import TIME
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.geometry import SH_C0


def load_yardstick(folder: Path) -> Any:
    """Import the yardstick's ``iter`` module.

    Raises:
        DataError: the folder has none, or it cannot be imported.
    """
    if not (folder / "iter.py").is_file():
        raise DataError(f"{folder}: holds no yardstick (no iter.py)")
    os.environ.setdefault("RC", "1")
    sys.path.insert(0, str(folder))
    try:
        return importlib.import_module("iter")
    except ImportError as error:
        raise DataError(f"{folder}: the yardstick cannot be imported: {error}") from error
    finally:
        sys.path.remove(str(folder))


def _prepared(module: Any, size: int, count: int) -> Any:
    """Return the yardstick's state with our splats under our camera."""
    state, splats, view = module.It(count, size, size), cloud(count), camera(size)
    state.x0[:], state.q0[:] = splats.means.numpy(), splats.quats.numpy()
    state.l0[:], state.lo[:] = splats.log_scales.numpy(), splats.logit_opacities.numpy()
    state.col[:] = 0.5 + SH_C0 * splats.sh[:, 0].numpy()
    state.fc = np.float32(view.fx)
    state.Rm, state.t = view.rotation.astype(np.float32), view.translation.astype(np.float32)
    state.hexf(TIME)
    state.mlpf()
    state.projf()
    state.rastf()
    return state


def drawing(module: Any, size: int, count: int) -> Callable[[], None]:
    """Return a function that projects, draws and goes back, as ``workloads.drawing`` does."""
    state = _prepared(module, size, count)
    state.gI[:] = np.random.default_rng(0).normal(size=state.gI.shape)

    def run() -> None:
        state.projf()
        state.rastf()
        state.rastb()
        state.projb()

    return run


def training_step(module: Any, size: int, count: int) -> Callable[[], None]:
    """Return a function that makes the yardstick's training step at rate 0."""
    state = _prepared(module, size, count)
    noise = np.random.default_rng(0).normal(size=state.R.img.shape)
    target = (state.R.img + 0.05 * noise).astype(np.float32)
    own_step = state.opt
    state.opt = lambda: own_step(0, 0)

    def run() -> None:
        state.step(target, TIME)

    return run
