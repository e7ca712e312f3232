"""``gsdmsr benchmark scenes``: presets on scenes at equal lengths, and a table of scores."""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from gsdmsr_cli.benchmark.curves import charts_of
from gsdmsr_cli.benchmark.scoreboard import HEADS, TEXTS, cells, markdown, rows_of
from gsdmsr_cli.benchmark.trials import Terms, all_trials, run_trial
from gsdmsr_cli.files import write_json, write_text
from gsdmsr_cli.formats import read_scene

SCHEMA = 1

WIDTH = 200
"""Columns of text for the table: a narrow terminal had better wrap lines than fold cells."""


def run(
    scenes: Sequence[Path],
    out: Path,
    presets: Sequence[str | Path],
    lengths: Sequence[str | int],
    seeds: Sequence[int],
    terms: Terms,
    as_json: bool,
) -> None:
    """Run every trial that is still to do, and write ``table.json``, ``table.md`` and charts.

    They are written after every trial, so that an interrupted benchmark leaves a table.

    Raises:
        UsageError: a preset or a length does not exist.
        DataError: a scene or a folder below ``out`` cannot be used.
        GsdmsrError: a trial has failed.
        KeyboardInterrupt: Ctrl-C; the same command goes on.
    """
    trials = all_trials(scenes, presets, lengths, seeds)
    for trial in trials:  # told now rather than after hours
        trial.options(terms)
    for scene in scenes:
        read_scene(scene)
    console, scored = Console(stderr=True), []
    for number, trial in enumerate(trials, start=1):
        console.out(f"trial {number} of {len(trials)}: {trial.folder(out)}", highlight=False)
        scored.append((trial, run_trial(trial, out, terms)))
        rows = rows_of(scored)
        _write(out, rows, terms)
        for name, chart in charts_of([trial for trial, _ in scored], out).items():
            write_text(out / f"psnr-{name}.svg", chart)
    if as_json:
        sys.stdout.write(json.dumps(_document(rows, terms)) + "\n")
    else:
        Console(width=WIDTH).print(_table(rows, terms))
        Console().out(f"written to {out / 'table.md'}", highlight=False)


def _document(rows: Sequence[dict[str, Any]], terms: Terms) -> dict[str, Any]:
    about = {
        "split": terms.split,
        "downscale": terms.downscale,
        "background": terms.background,
    }
    return {"schema": SCHEMA, "protocol": about, "rows": list(rows)}


def _write(out: Path, rows: Sequence[dict[str, Any]], terms: Terms) -> None:
    write_json(out / "table.json", _document(rows, terms))
    write_text(out / "table.md", markdown(rows))


def _table(rows: Sequence[dict[str, Any]], terms: Terms) -> Table:
    about = f"{terms.split} split, downscale {terms.downscale}, on {terms.background}"
    table = Table(title=about)
    for place, name in enumerate(HEADS):
        table.add_column(name, justify="left" if place < TEXTS else "right")
    for row in rows:
        table.add_row(*cells(row))
    return table
