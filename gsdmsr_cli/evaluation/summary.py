"""Formats the results of an evaluation as short texts for tables."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsdmsr_cli.evaluation.catalogue import METRICS

SCHEMA = 1
"""Of the document; another number is another layout."""

Document = Mapping[str, Any]
"""The content of a ``metrics.json``."""


def value_of(aggregate: Mapping[str, Any], metric: str) -> float | None:
    """Return the number that a report's aggregate has for a metric, or None."""
    entry = aggregate.get(metric)
    value: float | None = entry.get("value") if isinstance(entry, Mapping) else entry
    return value


def title(document: Document) -> str:
    """Return what has been compared, in one line."""
    about = document["protocol"]
    width, height = about["resolution"]
    return (
        f"{about['split']} split, {len(document['frames'])} frames of {width} x {height} px, "
        f"step {about['checkpoint_step']}"
    )


def backgrounds(document: Document) -> dict[str, Mapping[str, Any]]:
    """Return by background its ``aggregate`` and ``frames``, the report's own first."""
    return {document["protocol"]["background"]: document, **document["backgrounds"]}


def metric_rows(document: Document) -> list[tuple[str, ...]]:
    """Return for every metric its name and its mean over each background, or why it has none."""
    aggregates = [over["aggregate"] for over in backgrounds(document).values()]
    present = [metric for metric in METRICS if metric in aggregates[0]]
    return [
        (metric, *(_shown(aggregate, metric) for aggregate in aggregates)) for metric in present
    ]


def _shown(aggregate: Mapping[str, Any], metric: str) -> str:
    value, entry = value_of(aggregate, metric), aggregate.get(metric)
    if value is not None:
        return f"{value:.4f}"
    return f"none: {entry['reason'] if entry else 'a render holds NaN'}"


def split_rows(document: Document) -> list[tuple[str, str, str]]:
    """Return for every split its name, its PSNR and over how many of its views."""
    return [
        (split, "none" if own["psnr"] is None else f"{own['psnr']:.4f}", str(own["frames"]))
        for split, own in document["splits"].items()
    ]


def other_rows(document: Document) -> list[tuple[str, str]]:
    """Return speed, size and length of the training."""
    speed, stored, training = (document[key] for key in ("speed", "storage", "training"))
    model = stored["splats_bytes"] + stored["motion_bytes"]
    return [
        ("frames a second", f"{speed['fps']:.1f}"),
        ("frames a second without motion", f"{speed['fps_raster']:.1f}"),
        ("model", f"{training['splats']:,} splats, {model / 1e6:.2f} MB"),
        ("training", f"{training['steps']:,} steps in {training['train_s']:.0f} s"),
    ]


def machine(document: Document) -> str:
    """Return what the figures were measured on."""
    about = document["protocol"]
    return f"{about['gpu'] or about['processor']} ({about['device']})"
