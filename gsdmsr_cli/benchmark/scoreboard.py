"""What trials have scored, as a table: a row for each scene, preset and length, and means."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from gsdmsr_cli.benchmark.trials import Trial
from gsdmsr_cli.evaluation.protocol import average
from gsdmsr_cli.scene.scene import SPLITS

MEAN = "mean"
"""What stands for a scene in the rows that average over scenes."""

COLUMNS = {
    "psnr": ".2f",
    "spread": ".2f",
    "train_psnr": ".2f",
    "val_psnr": ".2f",
    "test_psnr": ".2f",
    "psnr_fitted": ".2f",
    "psnr_moving": ".2f",
    "psnr_static": ".2f",
    "ssim": ".4f",
    "lpips_alex": ".4f",
    "fps": ".0f",
    "fps_raster": ".0f",
    "model_mb": ".2f",
    "splats": ".0f",
    "steps": ".0f",
    "ms_per_step": ".1f",
    "peak_mib": ".0f",
}
"""The measured columns and how they are written; all but the spread are means over seeds."""

HEADS = ("scene", "preset", "length", "trials", *COLUMNS)
TEXTS = 3
"""The columns of a table, and how many of them, the first ones, are no numbers."""

Scored = Sequence[tuple[Trial, Mapping[str, Any]]]


def rows_of(scored: Scored) -> list[dict[str, Any]]:
    """Return the rows of trials and their ``metrics.json``.

    The trials of a row differ in their seeds; its ``spread`` is the largest PSNR of them less the
    smallest, None for a single one. Where there are several scenes, rows follow that average over
    all of them. A value that any trial lacks is None.
    """
    groups: dict[tuple[str | int, str, str], list[dict[str, float | None]]] = {}
    for trial, document in scored:
        key = trial.length, trial.name, trial.scene.resolve().name
        groups.setdefault(key, []).append(_values(document))
    rows = [_row(key, values) for key, values in groups.items()]
    means: dict[tuple[str | int, str], list[dict[str, Any]]] = {}
    for row in rows:
        means.setdefault((row["length"], row["preset"]), []).append(row)
    if len({row["scene"] for row in rows}) > 1:
        rows += [_row((*key, MEAN), own) | {"spread": None} for key, own in means.items()]
    return rows


def _values(document: Mapping[str, Any]) -> dict[str, float | None]:
    aggregate, training = document["aggregate"], document["training"]
    storage, splits = document["storage"], document["splits"]
    return {
        "psnr": aggregate["psnr"],
        **{f"{split}_psnr": splits.get(split, {}).get("psnr") for split in SPLITS},
        **{
            f"psnr_{what}": aggregate.get(f"psnr_{what}") for what in ("fitted", "moving", "static")
        },
        "ssim": aggregate["ssim"],
        "lpips_alex": aggregate["lpips_alex"]["value"],
        **{name: document["speed"][name] for name in ("fps", "fps_raster")},
        "model_mb": (storage["splats_bytes"] + storage["motion_bytes"]) / 1e6,
        "splats": training["splats"],
        "steps": training["steps"],
        "ms_per_step": 1e3 * training["train_s"] / training["steps"],
        "peak_mib": training.get("peak_rss_mib"),
    }


def _row(
    key: tuple[str | int, str, str], values: Sequence[Mapping[str, float | None]]
) -> dict[str, Any]:
    length, preset, scene = key
    row = {"scene": scene, "preset": preset, "length": length, "trials": len(values)}
    numbers = [value["psnr"] for value in values if value["psnr"] is not None]
    spread = max(numbers) - min(numbers) if len(numbers) > 1 else None
    measured = [{name: value[name] for name in COLUMNS if name != "spread"} for value in values]
    return row | {"spread": spread} | average(measured)


def cells(row: Mapping[str, Any]) -> list[str]:
    """Return the row as texts, in the order of ``HEADS``."""
    values = [(row[name], COLUMNS.get(name, "")) for name in HEADS]
    return ["" if value is None else format(value, form) for value, form in values]


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return the rows as a table in Markdown."""
    rule = ["---"] * TEXTS + ["---:"] * (len(HEADS) - TEXTS)
    lines = [HEADS, rule, *map(cells, rows)]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)
