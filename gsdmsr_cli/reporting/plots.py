"""Draws the charts of an evaluation: scores over the scene's time, and over training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gsdmsr_cli.evaluation import summary
from gsdmsr_cli.evaluation.summary import Document
from gsdmsr_cli.ground.charts import Line, line_chart

SIZE = (440, 300)
"""Of a chart, such that its text can be read on a phone."""

Log = Sequence[Mapping[str, Any]]
"""Entries of the log of a training."""


def plots(document: Document, log: Log) -> list[str]:
    """Return the charts as SVG, without those that have nothing to show."""
    charts = [_over_time(document), _psnr_in_training(log), _splats_in_training(log)]
    return [chart for chart in charts if chart]


def _over_time(document: Document) -> str:
    split = document["protocol"]["split"]
    lines = [_line(name, over["frames"]) for name, over in summary.backgrounds(document).items()]
    return _chart(f"PSNR of the {split} frames", "time in the scene", "PSNR [dB]", lines)


def _line(background: str, frames: Sequence[Mapping[str, Any]]) -> Line:
    found = sorted(
        (frame["time"], frame["psnr"], f"{frame['name']}: {frame['psnr']:.2f} dB")
        for frame in frames
        if frame["psnr"] is not None
    )
    points = [(time, psnr) for time, psnr, _ in found]
    return Line(f"on {background}", points, [label for _, _, label in found])


def _psnr_in_training(log: Log) -> str:
    lines = [
        Line(f"one {split} view", _course(log, f"{split}_psnr"))
        for split in ("val", "train")
        if any(f"{split}_psnr" in entry for entry in log)
    ]
    return _chart("PSNR while training", "seconds of training", "PSNR [dB]", lines)


def _splats_in_training(log: Log) -> str:
    lines = [Line("Gaussians", _course(log, "splats"))]
    return _chart("Gaussians while training", "seconds of training", "", lines)


def _course(log: Log, key: str) -> list[tuple[float, float]]:
    return [(entry["elapsed"], entry[key]) for entry in log if entry.get(key) is not None]


def _chart(title: str, x_label: str, y_label: str, lines: Sequence[Line]) -> str:
    if all(len(line.points) < 2 for line in lines):
        return ""
    return line_chart(title, x_label, y_label, lines, SIZE)
