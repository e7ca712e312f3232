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

from gsdmsr_cli.commands._measure import measure
from gsdmsr_cli.commands._trained import open_trained
from gsdmsr_cli.errors import ThresholdError, UsageError, nearest
from gsdmsr_cli.evaluation.catalogue import METRICS, less_is_better
from gsdmsr_cli.evaluation.protocol import value_of
from gsdmsr_cli.evaluation.request import BOTH, Request
from gsdmsr_cli.files import write_json

Thresholds = list[tuple[str, float]]


def run(
    run_folder: Path,
    request: Request,
    as_json: bool = False,
    fail_under: Sequence[str] = (),
    data: Path | None = None,
) -> None:
    """Write ``RUN/eval/metrics.json`` and print it, as a table or as JSON.

    Raises:
        UsageError: a threshold names no metric or no number.
        DataError: the run, its data or the weights cannot be used.
        ThresholdError: a metric is worse than its threshold, or has no value.
    """
    thresholds = [_threshold(text) for text in fail_under]
    background = None if request.background == BOTH else request.background
    trained = open_trained(run_folder, data, background, request.downscale)
    document = measure(trained, request)
    path = run_folder / "eval" / "metrics.json"
    write_json(path, document)
    if as_json:
        Console().out(json.dumps(document), highlight=False)
    else:
        Console().print(_table(document))
        Console().out(f"written to {path}", highlight=False)
    _check(document["aggregate"], thresholds)


def _threshold(text: str) -> tuple[str, float]:
    """Return the metric and the number of "metric=value"."""
    metric, equals, value = text.partition("=")
    if equals and metric not in METRICS:
        raise UsageError(f"--fail-under {text}: no such metric; {nearest(metric, METRICS)}")
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
        value, less = value_of(aggregate, metric), less_is_better(metric)
        passes = value is not None and (value <= threshold if less else value >= threshold)
        if not passes:
            bound = "or less" if less else "or more"
            found = "has no value" if value is None else f"is {value:.6g}"
            missed.append(f"{metric} {found}, wanted {threshold:g} {bound}")
    if missed:
        raise ThresholdError("; ".join(missed))


def _table(document: Mapping[str, Any]) -> Table:
    about = document["protocol"]
    width, height = about["resolution"]
    others = document["backgrounds"]
    title = (
        f"{about['split']} split, {len(document['frames'])} frames of {width} x {height} px, "
        f"step {about['checkpoint_step']}"
    )
    table = Table("metric", f"on {about['background']}", *map("on {}".format, others), title=title)
    aggregates = [document["aggregate"], *(other["aggregate"] for other in others.values())]
    for metric in METRICS:
        if metric in aggregates[0]:
            table.add_row(metric, *(_shown(aggregate, metric) for aggregate in aggregates))
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


def _shown(aggregate: Mapping[str, Any], metric: str) -> str:
    value, entry = value_of(aggregate, metric), aggregate[metric]
    if value is not None:
        return f"{value:.4f}"
    return f"none: {escape(entry['reason']) if entry else 'a render holds NaN'}"
