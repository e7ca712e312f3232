"""Draws test views of several runs side by side, and the true pictures last.

    python docs/pictures/beside.py OUT.webp VIEW[,VIEW...] RUN RUN...

A row for each view, by the name that it has in the report, at half the size; all runs are of the
same data and size.
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
    height, width = pixels.shape[0] // 2, pixels.shape[1] // 2
    halved = cv2.resize(pixels, (width, height), interpolation=cv2.INTER_AREA)
    out.write_bytes(encode_webp(np.asarray(halved, np.uint8), QUALITY))


def _eight_bits(picture: Tensor) -> NDArray[np.uint8]:
    return (picture.clamp(0, 1) * 255).round().byte().numpy()


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2].split(","), [Path(run) for run in sys.argv[3:]])
