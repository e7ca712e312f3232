"""``gsdmsr benchmark still``: measures PSNR and speed if splats that hardly move are frozen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

from rich.table import Table

from gsdmsr_cli.commands._progress import part_of, progress_bar
from gsdmsr_cli.commands._trained import Trained, open_trained
from gsdmsr_cli.evaluation import protocol
from gsdmsr_cli.evaluation.speed import measure_speed
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.scene.scene import View
from gsdmsr_cli.training.population.stillness import motion_saliency
from gsdmsr_cli.training.resizing import resize_model
from gsdmsr_cli.training.standing import let_stand_still

SCHEMA = 1

ROUNDS = 3
"""How often each model's speed is measured, in turns, so that a busy machine disturbs all alike."""


def run(run_folder: Path, below: Sequence[float], split: str, data: Path | None) -> None:
    """Print share of still splats, PSNR and frames a second for each threshold, and without.

    Raises:
        UsageError: a threshold is not above 0.
        DataError: the run or its data cannot be used.
    """
    for threshold in below:
        if not threshold > 0:
            raise UsageError(f"--below {threshold}: must be above 0")
    with open_trained(run_folder, data) as trained:
        rows = _measure(trained, below, split)
    say.result({"schema": SCHEMA, "split": split, "rows": rows}, _table(rows, split))


def _measure(trained: Trained, below: Sequence[float], split: str) -> list[dict[str, Any]]:
    """Return a row of the table for each threshold, and first one without."""
    views = trained.scene.split(split)
    camera = trained.renderer.pictures.camera(views[0])
    saliency, mean = motion_saliency(trained.renderer.model, camera)
    models = {0.0: trained.renderer.model}
    for threshold in below:
        models[threshold] = deepcopy(trained.renderer.model)
        change = let_stand_still(models[threshold], saliency < threshold, mean)
        resize_model(models[threshold], change)
    speeds = _speeds(trained, models, views)
    rows: list[dict[str, Any]] = []
    total = len(models) * len(views)
    with progress_bar("comparing pictures") as on_progress:
        for number, (threshold, model) in enumerate(models.items()):
            renderer, before = replace(trained.renderer, model=model), number * len(views)
            scored = protocol.score_views(renderer, views, {}, part_of(on_progress, before, total))
            rows.append(
                {
                    "below": threshold,
                    "still": 1 - model.moving / len(model.splats),
                    "psnr": protocol.average([scores for _, scores in scored])["psnr"],
                    "fps": speeds[threshold],
                    "ratio": speeds[threshold] / speeds[0.0],
                }
            )
    return rows


def _speeds(
    trained: Trained, models: Mapping[float, Model], views: Sequence[View]
) -> dict[float, float]:
    """Return the frames a second of each model."""
    renderer = trained.renderer
    shots = [(renderer.pictures.camera(view), view.time) for view in views]
    found: dict[float, list[float]] = {threshold: [] for threshold in models}
    for _ in range(ROUNDS):
        for threshold, model in models.items():
            speed = measure_speed(model, shots, renderer.engine, renderer.background)
            found[threshold].append(speed.fps)
    return {threshold: median(rates) for threshold, rates in found.items()}


def _table(rows: Sequence[Mapping[str, Any]], split: str) -> Table:
    table = Table("still below", "still", f"psnr ({split})", "frames a second", "ratio")
    for row in rows:
        psnr = "none" if row["psnr"] is None else f"{row['psnr']:.2f}"
        table.add_row(
            f"{row['below']:g}" if row["below"] else "as trained",
            f"{100 * row['still']:.1f} %", psnr, f"{row['fps']:.0f}", f"{row['ratio']:.2f}",
        )  # fmt: skip
    return table
