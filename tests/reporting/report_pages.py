"""A page as tests need it: of a small report, with pictures of noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from reports import small_report

from gsdmsr_cli.reporting.frames import ReportFrame, data_url
from gsdmsr_cli.reporting.page import page

LOG = [
    {"step": 10 * i, "elapsed": 1.5 * i, "splats": 100 + i, "val_psnr": 20.0 + i} for i in range(9)
]


def noisy_frame(index: int, worst: bool, side: int = 64) -> ReportFrame:
    rng = np.random.default_rng(index)
    urls = [data_url(rng.integers(0, 256, (side, side, 3), dtype=np.uint8)) for _ in range(4)]
    return ReportFrame(index, worst, side, side, *urls)


SHOWN_FRAMES = [noisy_frame(0, True), noisy_frame(1, False)]


def write_page(path: Path) -> Path:
    path.write_text(page("a run", small_report(), [], LOG, SHOWN_FRAMES, 0.1), encoding="utf-8")
    return path
