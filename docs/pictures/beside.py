"""Draws test views of several runs side by side, and the true pictures last.

    python docs/pictures/beside.py OUT.webp VIEW[,VIEW...] RUN RUN...

A row for each view, by the name that it has in the report; wide pictures at half the size. All runs
are of the same data and size.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from gsdmsr_cli.commands._trained import open_trained
from gsdmsr_cli.scene.imaging import encode_webp
from gsdmsr_cli.scene.native import cv2

QUALITY = 75
"""Of WebP, 0 to 100."""

WIDE = 480
"""Width of a picture above which it is shown at half its size [px]."""


def main(out: Path, names: list[str], runs: list[Path]) -> None:
    """Write the picture."""
    with ExitStack() as held:
        opened = [held.enter_context(open_trained(run, None)) for run in runs]
        views = {view.name: view for view in opened[0].scene.split("test")}
        rows = []
        for name in names:
            drawn = [one.renderer.draw(views[name]) for one in opened]
            rows.append([_eight_bits(p) for p in (*drawn, opened[0].renderer.true(views[name]))])
    pixels = np.concatenate([np.concatenate(row, axis=1) for row in rows])
    if pixels.shape[1] > WIDE * (len(runs) + 1):
        size = pixels.shape[1] // 2, pixels.shape[0] // 2
        pixels = np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)
    out.write_bytes(encode_webp(pixels, QUALITY))


def _eight_bits(picture: Tensor) -> NDArray[np.uint8]:
    return (picture.clamp(0, 1) * 255).round().byte().numpy()


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2].split(","), [Path(run) for run in sys.argv[3:]])
