"""A page as tests need it: of a small report, with pictures of noise."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from reports import small_report

from gsdmsr_cli.reporting.page import page
from gsdmsr_cli.reporting.stills import Still, data_url

LOG = [
    {"step": 10 * i, "elapsed": 1.5 * i, "splats": 100 + i, "val_psnr": 20.0 + i} for i in range(9)
]


def noisy_still(index: int, worst: bool, side: int = 64) -> Still:
    rng = np.random.default_rng(index)
    urls = [data_url(rng.integers(0, 256, (side, side, 3), dtype=np.uint8)) for _ in range(4)]
    return Still(index, worst, side, side, *urls)


STILLS = [noisy_still(0, True), noisy_still(1, False)]


def write_page(path: Path) -> Path:
    path.write_text(page("a run", small_report(), [], LOG, STILLS, 0.1), encoding="utf-8")
    return path
