"""gsdmsr eval: measures a run on views that it has not seen."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from gsdmsr_cli import machine
from gsdmsr_cli.commands._progress import part_of, progress_bar
from gsdmsr_cli.commands._trained import Trained, open_trained
from gsdmsr_cli.errors import ThresholdError, UsageError, nearest
from gsdmsr_cli.evaluation import protocol
from gsdmsr_cli.evaluation.lpips import NETS, Lpips, Missing
from gsdmsr_cli.evaluation.speed import measure_speed
from gsdmsr_cli.files import read_json, write_json
from gsdmsr_cli.scene import SPLITS, View

SCHEMA = 1

OTHER_VIEWS = 20
"""Views of every other split, evenly spaced, whose PSNR is reported beside that of ``split``."""

_DISTANCES = tuple(f"lpips_{net}" for net in NETS)
_METRICS = ("psnr", "psnr_float", "ssim", *_DISTANCES)

Thresholds = list[tuple[str, float]]
Scored = Sequence[tuple[View, protocol.Scores]]


def run(
    run_folder: Path,
    split: str,
    background: str | None,
    downscale: int | None,
    lpips_weights: Path | None,
    as_json: bool,
    fail_under: Sequence[str],
    data: Path | None = None,
) -> None:
    """Write ``RUN/eval/metrics.json`` and print it, as a table or as JSON.

    Raises:
        UsageError: a threshold names no metric or no number.
        DataError: the run, its data or the weights cannot be used.
        ThresholdError: a metric is worse than its threshold, or has no value.
    """
    thresholds = [_threshold(text) for text in fail_under]
    trained = open_trained(run_folder, data, background, downscale)
    document = _measure(trained, split, background, downscale, lpips_weights)
    path = run_folder / "eval" / "metrics.json"
    write_json(path, document)
    if as_json:
        Console().out(json.dumps(document), highlight=False)
    else:
        Console().print(_table(document))
        Console().out(f"written to {path}", highlight=False)
    _check(document["aggregate"], thresholds)


def _measure(
    trained: Trained,
    split: str,
    background: str | None,
    downscale: int | None,
    lpips_weights: Path | None,
) -> dict[str, Any]:
    views, studio = trained.scene.split(split), trained.studio
    camera = studio.pictures.camera(views[0])
    resolution = camera.width, camera.height
    nets = protocol.load_nets(resolution, folder=lpips_weights)
    by_split = _score_splits(trained, split, nets)
    frames = by_split[split]
    shots = [(studio.pictures.camera(view), view.time) for view in views]
    speed = measure_speed(studio.model, shots, studio.engine, studio.background)
    aggregate = _mean(frames)
    options, checkpoint = trained.run.preset, trained.checkpoint
    return {
        "schema": SCHEMA,
        "protocol": {
            "split": split,
            "resolution": list(resolution),
            "downscale": downscale or options.data.downscale,
            "background": background or options.data.background,
            "checkpoint": "last",
            "checkpoint_step": checkpoint.step,
            "progress": checkpoint.progress,
            "device": trained.device,
            "processor": machine.cpu_name(),
            "preset": trained.run.name,
            "motion": options.motion["name"],
            "seed": options.training.seed,
            "data_fingerprint": trained.run.fingerprint,
            "conventions": protocol.CONVENTIONS,
            "versions": machine.versions(),
        },
        "aggregate": protocol.with_reasons(aggregate, nets),
        "splits": {
            name: {"psnr": _mean(scored)["psnr"], "frames": len(scored)}
            for name, scored in by_split.items()
        },
        "frames": [{"name": view.name, "time": view.time, **scores} for view, scores in frames],
        "speed": speed.document(),
        "storage": {
            "checkpoint_bytes": trained.run.checkpoint_path.stat().st_size,
            **protocol.storage(checkpoint.tensors),
        },
        "training": _training(trained),
    }


def _score_splits(
    trained: Trained, split: str, nets: Mapping[str, Lpips | Missing]
) -> dict[str, Scored]:
    """Return the scores of all views of one split, and of some of every other there is."""
    chosen: dict[str, Sequence[View]] = {split: trained.scene.split(split)}
    for other in SPLITS:
        views = [view for view in trained.scene.views if view.split == other]
        if views and other != split:
            chosen[other] = _evenly(views, OTHER_VIEWS)
    total = sum(map(len, chosen.values()))
    scored: dict[str, Scored] = {}
    with progress_bar("comparing pictures") as tell:
        for name, own_views in chosen.items():
            before, own = sum(map(len, scored.values())), nets if name == split else {}
            scored[name] = protocol.score_views(
                trained.studio, own_views, own, part_of(tell, before, total)
            )
    return scored


def _mean(scored: Scored) -> protocol.Scores:
    return protocol.average([scores for _, scores in scored])


def _evenly(views: Sequence[View], count: int) -> list[View]:
    """Return ``count`` of the views, or all if there are fewer."""
    count = min(count, len(views))
    return [views[i * len(views) // count] for i in range(count)]


def _training(trained: Trained) -> dict[str, Any]:
    """Return how the training went; one that was killed has left nothing but a checkpoint."""
    path, checkpoint = trained.run.training_path, trained.checkpoint
    said = read_json(path) if path.is_file() else {}
    splats = len(trained.studio.model.splats)
    known = {"steps": checkpoint.step, "train_s": checkpoint.elapsed, "splats": splats}
    return known | (said if said.get("steps") == checkpoint.step else {})


def _threshold(text: str) -> tuple[str, float]:
    """Return the metric and the number of "metric=value"."""
    metric, equals, value = text.partition("=")
    if equals and metric not in _METRICS:
        raise UsageError(f"--fail-under {text}: no such metric; {nearest(metric, _METRICS)}")
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not math.isfinite(number):
        raise UsageError(f"--fail-under {text}: allowed: METRIC=NUMBER, as in psnr=25")
    return metric, number


def _check(aggregate: Mapping[str, Any], thresholds: Thresholds) -> None:
    """Raise ThresholdError listing every threshold that is missed."""
    missed = []
    for metric, threshold in thresholds:
        value = _value(aggregate, metric)
        less_is_better = metric in _DISTANCES
        passes = value is not None and (
            value <= threshold if less_is_better else value >= threshold
        )
        if not passes:
            bound = "or less" if less_is_better else "or more"
            found = "has no value" if value is None else f"is {value:.6g}"
            missed.append(f"{metric} {found}, wanted {threshold:g} {bound}")
    if missed:
        raise ThresholdError("; ".join(missed))


def _value(aggregate: Mapping[str, Any], metric: str) -> float | None:
    entry = aggregate[metric]
    value: float | None = entry["value"] if isinstance(entry, Mapping) else entry
    return value


def _table(document: Mapping[str, Any]) -> Table:
    about, aggregate = document["protocol"], document["aggregate"]
    width, height = about["resolution"]
    title = (
        f"{about['split']} split, {len(document['frames'])} frames of {width} x {height} px on "
        f"{about['background']}, step {about['checkpoint_step']}"
    )
    table = Table("metric", "value", title=title)
    for metric in _METRICS:
        value = _value(aggregate, metric)
        reason = "" if value is not None else _reason(aggregate[metric])
        table.add_row(metric, f"{value:.4f}" if value is not None else f"none: {escape(reason)}")
    for split, scores in document["splits"].items():
        if split != about["split"]:
            value = scores["psnr"]
            table.add_row(f"psnr of {split} views", "none" if value is None else f"{value:.4f}")
    table.add_row("frames a second", f"{document['speed']['fps']:.1f}")
    table.add_row("  without motion", f"{document['speed']['fps_raster']:.1f}")
    stored = document["storage"]
    model = stored["splats_bytes"] + stored["motion_bytes"]
    table.add_row("model", f"{document['training']['splats']} splats, {model / 1e6:.1f} MB")
    return table


def _reason(entry: Mapping[str, Any] | None) -> str:
    return str(entry["reason"]) if entry else "a render holds NaN"
