"""``gsdmsr benchmark kernels``: times drawing and a training step, and compares them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from rich.table import Table

from gsdmsr_cli import raster
from gsdmsr_cli.backends.cpu.jit import threads
from gsdmsr_cli.backends.cuda import availability
from gsdmsr_cli.benchmark import gsplat, workloads, yardstick
from gsdmsr_cli.benchmark.timing import in_turns
from gsdmsr_cli.commands._progress import progress_bar
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import UsageError

CASES = {
    "cpu": ((400, 20_000), (800, 50_000), (800, 100_000)),
    "cuda": ((800, 50_000), (800, 200_000), (800, 1_000_000)),
}
"""Sides of pictures and numbers of splats, by device."""

MOTIONS = ("hexplane", "multiscale", "control_points")


def run(yardstick_folder: Path | None, device: str) -> None:
    """Time every case, in turns with a yardstick if there is one, and print a table.

    On the CPU that is a folder of other kernels, on a GPU gsplat where it is installed.

    Raises:
        UsageError: a folder is given for a GPU.
        DataError: the device is not there, or the folder holds no yardstick.
    """
    where = raster.pick_device(device)
    other = _yardstick(yardstick_folder, where)
    rows = []
    for size, count in CASES[where]:
        with progress_bar(f"{size} x {size}, {count} splats"):
            rows += _measure(size, count, where, other)
    usage = availability.usage(where)
    document = {"schema": 1, "threads": threads(), "device": where, **usage, "rows": rows}
    say.result(document, _table(rows, _where(usage)))


def _yardstick(folder: Path | None, device: str) -> Any:
    """Return what is timed beside us, or None."""
    if device == "cpu":
        return None if folder is None else yardstick.load_yardstick(folder)
    if folder is not None:
        raise UsageError("--yardstick is for the CPU; on a GPU the yardstick is gsplat")
    found = gsplat.load_gsplat()
    if isinstance(found, str):
        say.note(f"without a yardstick: {found}")
        return None
    return found


def _measure(size: int, count: int, device: str, other: Any) -> list[dict[str, Any]]:
    functions: dict[str, Callable[[], object]] = {
        "draw forward + backward": workloads.drawing(size, count, device),
        "follow control points, forward + backward": workloads.following(count, device),
    }
    for motion in MOTIONS:
        step = workloads.training_step(size, count, motion, device)
        functions[f"training step, {motion}"] = step
    ours = list(functions)
    if other is not None and device == "cpu":
        functions["yardstick draw"] = yardstick.drawing(other, size, count)
        functions["yardstick step"] = yardstick.training_step(other, size, count)
    elif other is not None:
        functions["yardstick draw"] = gsplat.drawing(other, size, count, device)
    times = in_turns(functions)
    rows = []
    for name in ours:
        row = {"size": size, "splats": count, "what": name, "ms": times[name]}
        against = {"draw": "yardstick draw", "training": "yardstick step"}.get(name.split()[0])
        if against in times:
            row |= {"yardstick_ms": times[against], "ratio": times[name] / times[against]}
        rows.append(row)
    return rows


def _where(usage: dict[str, Any]) -> str:
    """Return on what was measured, and how much of a GPU's memory tensors have taken at most."""
    if usage["gpu"] is None:
        return f"{threads()} threads"
    return f"{usage['gpu']}, {usage['peak_gpu_mib']:,.0f} MiB of its memory at most"


def _table(rows: list[dict[str, Any]], on: str) -> Table:
    table = Table(title=f"Milliseconds, medians, {on}")
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
