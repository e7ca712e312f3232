"""gsdmsr compare: sets evaluations side by side, in a table and on a page with pictures."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from gsdmsr_cli.commands._progress import progress_bar
from gsdmsr_cli.commands._trained import open_trained
from gsdmsr_cli.evaluation.comparison import Compared, compare, most_disputed, rows_of
from gsdmsr_cli.evaluation.gates import read_report
from gsdmsr_cli.evaluation.summary import Document
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.files import write_text
from gsdmsr_cli.reporting.comparison import SideBySide, comparison_page
from gsdmsr_cli.reporting.frames import data_url, drawn_and_true
from gsdmsr_cli.runs.outputs import EVALUATION, METRICS
from gsdmsr_cli.scene.imaging import eight_bits
from gsdmsr_cli.scene.scene import View

SCHEMA = 1

SHOWN = 4
"""Frames on the page: those whose PSNR differs most between the runs."""


def run(paths: Sequence[Path], out: Path | None, data: Path | None) -> None:
    """Print the figures of several evaluations side by side.

    Args:
        paths: run folders that have been evaluated, or files that ``gsdmsr eval`` has written.
        out: page to write, with pictures of the run folders among them.
        data: where the data lies now, if not where it lay in training.

    Raises:
        UsageError: fewer than two are given, or one of them twice.
        DataError: one has not been evaluated or cannot be read, or the page not be written.
    """
    if len(paths) < 2:
        raise UsageError("compare needs two runs or more")
    names = _names(paths)
    reports = {name: _read(path) for name, path in zip(names, paths, strict=True)}
    compared = compare(reports)
    for one in compared[1:]:
        if one.differs:
            differs = ", ".join(one.differs)
            say.warn(f"{one.name} was measured otherwise than {names[0]}: {differs}")
    if out is not None:
        folders = dict(zip(names, paths, strict=True))
        frames = _side_by_side(compared, folders, data)
        write_text(out, comparison_page(names, rows_of(compared), _notes(compared), frames))
    document = {"schema": SCHEMA, "runs": [one.plain() for one in compared]}
    shown = [] if out is None else [f"written to {out}"]
    say.result(document, _table(names, rows_of(compared)), *_notes(compared), *shown)


def _names(paths: Sequence[Path]) -> list[str]:
    """Return short names of the runs; their paths where short ones are not unique."""
    folders = [path.resolve() for path in paths]
    if len(set(folders)) < len(folders):
        raise UsageError("compare is given the same run twice")
    runs = [path.parents[1] if _is_report_of_run(path) else path for path in folders]
    short = [path.name for path in runs]
    return short if len(set(short)) == len(short) else [str(path) for path in paths]


def _is_report_of_run(path: Path) -> bool:
    return path.is_file() and path.parent.name == EVALUATION


def _read(path: Path) -> Document:
    if path.is_file():
        return read_report(path)
    report = path / EVALUATION / METRICS
    if not report.is_file():
        raise DataError(f"{path}: has not been evaluated; run gsdmsr eval {path} first")
    return read_report(report)


def _notes(compared: Sequence[Compared]) -> list[str]:
    notes = ["* the best of those that were measured alike"]
    if any(one.differs for one in compared):
        notes.append("figures of runs with another protocol are not comparable with the first")
    return notes


def _table(names: Sequence[str], rows: Sequence[Sequence[str]]) -> Table:
    table = Table("", *(escape(name) for name in names))
    for row in rows:
        table.add_row(*map(escape, row))
    return table


def _side_by_side(
    compared: Sequence[Compared], folders: dict[str, Path], data: Path | None
) -> list[SideBySide]:
    """Return frames of the comparable runs whose folders are given, drawn anew."""
    drawable = [one for one in compared if folders[one.name].is_dir() and not one.differs]
    names = most_disputed(drawable, SHOWN) if drawable else []
    pictures: dict[str, list[tuple[str, str]]] = {name: [] for name in names}
    with progress_bar("drawing frames") as on_progress:
        for done, one in enumerate(drawable, start=1):
            _draw(one, folders[one.name], data, pictures)
            on_progress(done, len(drawable))
    return [SideBySide(name, tuple(shown)) for name, shown in pictures.items()]


def _draw(
    one: Compared, folder: Path, data: Path | None, pictures: dict[str, list[tuple[str, str]]]
) -> None:
    """Add a run's pictures to those of each frame, and at first the true one."""
    about = one.document["protocol"]
    scores = {frame["name"]: frame["psnr"] for frame in one.document["frames"]}
    with open_trained(folder, data, about["background"], about["downscale"]) as trained:
        if trained.checkpoint.step != about["checkpoint_step"]:
            raise DataError(
                f"{folder}: was evaluated at step {about['checkpoint_step']} and is at step "
                f"{trained.checkpoint.step} now; run gsdmsr eval {folder} again"
            )
        views: dict[str, View] = {v.name: v for v in trained.scene.split(about["split"])}
        for name, shown in pictures.items():
            drawn, true = drawn_and_true(trained.renderer, views[name])
            if not shown:
                shown.append(("true picture", data_url(eight_bits(true))))
            caption = f"{one.name}, PSNR {scores[name]:.2f}"
            shown.append((caption, data_url(eight_bits(drawn))))
