"""``gsdmsr benchmark scenes``: trains presets for equal times and compares their scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.table import Table

from gsdmsr_cli.benchmark.curves import charts_of
from gsdmsr_cli.benchmark.ray_trials import run_on_ray
from gsdmsr_cli.benchmark.scoreboard import HEADS, TEXTS, cells, markdown, rows_of
from gsdmsr_cli.benchmark.trials import Terms, Trial, all_trials, run_side_by_side, run_trial
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.files import write_json, write_text
from gsdmsr_cli.ground.limits import cores

SCHEMA = 1

WIDTH = 230
"""Columns of text for the table: a narrow terminal had better wrap lines than fold cells."""


def run(
    scenes: Sequence[Path],
    out: Path,
    presets: Sequence[str | Path],
    lengths: Sequence[str | int],
    seeds: Sequence[int],
    terms: Terms,
) -> None:
    """Run every trial that is still to do, and write ``table.json``, ``table.md`` and charts.

    They are written after every ``terms.jobs`` trials, which run side by side, or after each that
    a worker of Ray has finished, so that an interrupted benchmark leaves a table.

    Raises:
        UsageError: a preset or a length does not exist, or there are more jobs than cores.
        DataError: a scene or a folder below ``out`` cannot be used.
        GsdmsrError: a trial has failed.
        KeyboardInterrupt: Ctrl-C; the same command goes on.
    """
    if terms.workers is None and terms.jobs * (terms.threads or 1) > cores():
        asked = f"--jobs {terms.jobs}" + (f" of {terms.threads} threads" if terms.threads else "")
        raise UsageError(f"{asked}: this machine has {cores()} cores, give no more")
    if terms.workers is not None:  # which have other working folders
        out, scenes = out.absolute(), [scene.absolute() for scene in scenes]
        presets = [name.absolute() if isinstance(name, Path) else name for name in presets]
        weights = terms.lpips_weights
        terms = replace(terms, lpips_weights=weights.absolute() if weights else None)
    trials = all_trials(scenes, presets, lengths, seeds)
    for trial in trials:  # an error now rather than after hours
        trial.options(terms)
    for scene in scenes:
        read_scene(scene)
    run_all = _here if terms.workers is None else _on_ray
    scored = run_all(trials, out, terms)
    rows = rows_of(scored)
    written = f"written to {out / 'table.md'}"
    say.result(_document(rows, terms), _table(rows, terms), written, width=WIDTH)


_Scored = list[tuple[Trial, dict[str, Any]]]


def _here(trials: Sequence[Trial], out: Path, terms: Terms) -> _Scored:
    scored: _Scored = []
    for first in range(0, len(trials), terms.jobs):
        batch = trials[first : first + terms.jobs]
        for number, trial in enumerate(batch, start=first + 1):
            place = trial.folder(out) if terms.jobs == 1 else trial.log(out)
            say.note(f"trial {number} of {len(trials)}: {place}")
        if terms.jobs == 1:
            documents = [run_trial(trial, out, terms) for trial in batch]
        else:
            documents = run_side_by_side(batch, out, terms)
        scored += zip(batch, documents, strict=True)
        _write(out, scored, terms)
    return scored


def _on_ray(trials: Sequence[Trial], out: Path, terms: Terms) -> _Scored:
    found: dict[Trial, dict[str, Any]] = {}

    def add(trial: Trial, document: dict[str, Any]) -> None:
        found[trial] = document
        say.note(f"{len(found)} of {len(trials)} trials: {trial.log(out)}")
        _write(out, _in_order(trials, found), terms)

    run_on_ray(trials, out, terms, add)
    return _in_order(trials, found)


def _in_order(trials: Sequence[Trial], found: dict[Trial, dict[str, Any]]) -> _Scored:
    return [(trial, found[trial]) for trial in trials if trial in found]


def _document(rows: Sequence[dict[str, Any]], terms: Terms) -> dict[str, Any]:
    about = {
        "split": terms.split,
        "downscale": terms.downscale,
        "background": terms.background,
        "threads": terms.threads,
        "overrides": list(terms.overrides),
    }
    return {"schema": SCHEMA, "protocol": about, "rows": list(rows)}


def _write(out: Path, scored: _Scored, terms: Terms) -> None:
    rows = rows_of(scored)
    for name, chart in charts_of([trial for trial, _ in scored], out).items():
        write_text(out / f"psnr-{name}.svg", chart)
    write_json(out / "table.json", _document(rows, terms))
    write_text(out / "table.md", markdown(rows))


def _table(rows: Sequence[dict[str, Any]], terms: Terms) -> Table:
    about = f"{terms.split} split, downscale {terms.downscale}, on {terms.background}"
    if terms.workers is not None:
        about += f", {terms.threads} CPUs each on workers of Ray"
    elif terms.threads:
        about += f", {terms.threads} of {cores()} cores each"
    table = Table(title=", ".join([about, *terms.overrides]))
    for place, name in enumerate(HEADS):
        table.add_column(name, justify="left" if place < TEXTS else "right")
    for row in rows:
        table.add_row(*cells(row))
    return table
