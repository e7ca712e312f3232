"""``gsdmsr benchmark reading``: how long a large capture takes before the first step."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from rich.table import Table

from gsdmsr_cli.benchmark.reading import Phase, measure, write_capture
from gsdmsr_cli.commands._progress import progress_bar
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError

SCHEMA = 1


def run(out: Path, pictures: int, points: int) -> None:
    """Write a capture to the folder ``out``, read it, and print what each phase took.

    Raises:
        DataError: the folder is in use or cannot be written.
    """
    if out.exists() and any(out.iterdir()):
        raise DataError(f"{out}: is not empty; choose another --out, or remove it")
    with progress_bar("writing pictures") as on_progress:
        write_capture(out, pictures, points, on_progress)
    phases = list(measure(out))
    rows = [asdict(phase) for phase in phases]
    document = {"schema": SCHEMA, "pictures": pictures, "points": points, "phases": rows}
    say.result(document, _table(phases, f"{pictures} pictures, {points} points"))


def _table(phases: list[Phase], title: str) -> Table:
    table = Table("phase", "seconds", "most memory so far, MiB", title=title)
    for phase in phases:
        peak = "unknown" if phase.peak_mib is None else f"{phase.peak_mib:.0f}"
        table.add_row(phase.what, f"{phase.seconds:.1f}", peak)
    return table
