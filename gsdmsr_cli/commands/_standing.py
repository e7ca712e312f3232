"""Opens a run of what stands still, by which ``prepare`` masks what moves."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from gsdmsr_cli.capture.second_masks import Standing
from gsdmsr_cli.commands._trained import open_trained
from gsdmsr_cli.evaluation.protocol import ViewRenderer
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.scene import View

STANDS_STILL = "static"
"""Name of the motion that is none."""


@contextmanager
def open_standing(folder: Path, data: Path) -> Iterator[Standing]:
    """Open a run of what stands still in ``data``, which nobody replaces until the end.

    Raises:
        DataError: the run cannot be used, or it was trained on something else, or to move.
    """
    with open_trained(folder, data) as trained:
        name = trained.run.preset.motion["name"]
        if name != STANDS_STILL:
            raise DataError(
                f"{folder}: its splats move ({name}), and --masks-of takes a run of what stands "
                f"still: gsdmsr train --preset static-video --data {shlex.quote(str(data))}"
            )
        yield standing_of(trained.renderer, trained.checkpoint.sha256)


def standing_of(renderer: ViewRenderer, key: str) -> Standing:
    """Return what a renderer draws as a model of what stands still, told from others by ``key``."""
    return Standing(key, partial(_pixels, renderer.draw), partial(_pixels, renderer.true))


def _pixels(of: Callable[[View], Tensor], view: View) -> NDArray[np.float32]:
    return of(view).clamp(0, 1).contiguous().numpy()
