"""How the PSNR of trials rose over the time of their training, as a chart for each scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from gsdmsr_cli.benchmark.trials import Trial
from gsdmsr_cli.ground.charts import Line, line_chart
from gsdmsr_cli.runs.run import open_run


def charts_of(trials: Sequence[Trial], root: Path) -> dict[str, str]:
    """Return an SVG for each scene by its name: a line per trial, a colour per preset.

    The PSNR is that of the one view that the training reports, of val where the scene has it.

    Raises:
        DataError: a trial's run cannot be read.
    """
    by_scene: dict[str, list[Line]] = {}
    for trial in trials:
        lines = by_scene.setdefault(trial.scene.resolve().name, [])
        lines.append(Line(trial.name, _curve(open_run(trial.folder(root)).read_log())))
    return {
        scene: line_chart(f"{scene}: one held-out view", "minutes of training", "PSNR [dB]", lines)
        for scene, lines in by_scene.items()
    }


def _curve(log: Sequence[Mapping[str, Any]]) -> list[tuple[float, float]]:
    """Return minutes and PSNR of every report in which it is a number."""
    found = [(e["elapsed"] / 60, e.get("val_psnr", e.get("train_psnr"))) for e in log]
    return [(minutes, value) for minutes, value in found if value is not None]
