"""``gsdmsr benchmark kernels``: milliseconds of drawing and of a training step, and ratios."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from gsdmsr_cli.benchmark import workloads, yardstick
from gsdmsr_cli.benchmark.timing import in_turns
from gsdmsr_cli.kernels.jit import threads

CASES = ((400, 20_000), (800, 50_000))
MOTIONS = ("hexplane", "multiscale")


def run(yardstick_folder: Path | None, as_json: bool) -> None:
    """Time every case, in turns with the yardstick if a folder is given, and print a table."""
    other = None if yardstick_folder is None else yardstick.load_yardstick(yardstick_folder)
    console = Console(stderr=True)
    rows = []
    for size, count in CASES:
        with console.status(f"{size} x {size}, {count} splats"):
            rows += _measure(size, count, other)
    if as_json:
        sys.stdout.write(json.dumps({"schema": 1, "threads": threads(), "rows": rows}) + "\n")
    else:
        Console().print(_table(rows))


def _measure(size: int, count: int, other: Any) -> list[dict[str, Any]]:
    functions = {"draw forward + backward": workloads.drawing(size, count)}
    for motion in MOTIONS:
        functions[f"training step, {motion}"] = workloads.training_step(size, count, motion)
    if other is not None:
        functions["yardstick draw"] = yardstick.drawing(other, size, count)
        functions["yardstick step"] = yardstick.training_step(other, size, count)
    times = in_turns(functions)
    rows = []
    for name in list(functions)[: 1 + len(MOTIONS)]:
        row = {"size": size, "splats": count, "what": name, "ms": times[name]}
        if other is not None:
            against = "yardstick draw" if name.startswith("draw") else "yardstick step"
            row |= {"yardstick_ms": times[against], "ratio": times[name] / times[against]}
        rows.append(row)
    return rows


def _table(rows: list[dict[str, Any]]) -> Table:
    table = Table(title=f"Milliseconds, medians, {threads()} threads")
    table.add_column("picture")
    table.add_column("splats", justify="right")
    table.add_column("what")
    for heading in ("ms", "yardstick ms", "ratio"):
        table.add_column(heading, justify="right")
    for row in rows:
        measured = [row["ms"], row.get("yardstick_ms"), row.get("ratio")]
        cells = ["" if value is None else f"{value:.2f}" for value in measured]
        table.add_row(f"{row['size']}²", f"{row['splats']:,}", row["what"], *cells)
    return table
