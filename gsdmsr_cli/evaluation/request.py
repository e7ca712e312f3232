"""The options of ``gsdmsr eval``, in a module that imports nothing heavy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

BOTH = "both"
"""As a background: that of the training first, then the other."""


@dataclass(frozen=True)
class Request:
    """What one evaluation measures.

    Attributes:
        split: views to compare, "test" or "val".
        background: "white", "black" or "both"; that of the training if None.
        downscale: divisor of the pictures' sides; that of the training if None.
        lpips_weights: folder of LPIPS weights, if not in the usual places.
        lpips_inria: whether LPIPS on [0, 1] is wanted too.
        verify_data: whether every byte of the pictures must be as it was in training.
    """

    split: str = "test"
    background: str | None = None
    downscale: int | None = None
    lpips_weights: Path | None = None
    lpips_inria: bool = False
    verify_data: bool = False


@dataclass(frozen=True)
class Demands:
    """The checks of the metrics, as given on the command line.

    Attributes:
        fail_under: "metric=value", the least of metrics of which more is better.
        fail_over: "metric=value", the most of distances.
        baseline: an earlier ``metrics.json`` to compare with.
        tolerance: "metric=value", how much worse than the baseline a metric may be.
    """

    fail_under: Sequence[str] = ()
    fail_over: Sequence[str] = ()
    baseline: Path | None = None
    tolerance: Sequence[str] = ()


@dataclass(frozen=True)
class Output:
    """Where the figures go besides ``metrics.json``.

    Attributes:
        folder: where to write, if not ``RUN/eval``.
        junit: file of JUnit XML to write.
        github_summary: whether to append Markdown to the file that GitHub Actions names.
        report: whether to write ``report.html`` and ``report.md`` beside ``metrics.json``.
        play: whether to write a page beside them that plays the run, to which the report links.
    """

    folder: Path | None = None
    junit: Path | None = None
    github_summary: bool = False
    report: bool = False
    play: bool = False
