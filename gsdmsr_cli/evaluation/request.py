"""What eval is asked for, before anything heavy is imported."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

BOTH = "both"
"""As a background: that of the training first, then the other."""


@dataclass(frozen=True)
class Request:
    """The wishes of one evaluation.

    Attributes:
        split: views to compare, "test" or "val".
        background: "white", "black" or "both"; that of the training if None.
        downscale: divisor of the pictures' sides; that of the training if None.
        lpips_weights: folder of LPIPS weights, if not in the usual places.
        lpips_inria: whether LPIPS on [0, 1] is wanted too.
    """

    split: str = "test"
    background: str | None = None
    downscale: int | None = None
    lpips_weights: Path | None = None
    lpips_inria: bool = False
