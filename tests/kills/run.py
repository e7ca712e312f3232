"""The long run of kills: ``python tests/kills/run.py --points 200``.

Commands that write are killed by SIGKILL before changes of the disk that are spread over all that
they make. After each kill old or new must be whole, and the next command must come to the end that
there is without a kill. Prints a table and ends with 1 if anything is not so.
"""

from __future__ import annotations

import argparse
import shutil
import sys
import tempfile
import time
import traceback
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

sys.path[:0] = [str(Path(__file__).parents[1] / folder) for folder in ("", "capture")]

import killed  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.table import Table  # noqa: E402
from works import Work, works  # noqa: E402


@dataclass(frozen=True)
class Point:
    """What became of a command that was to be killed before its ``number``-th change.

    Attributes:
        fault: what was wrong after it; None if nothing.
    """

    number: int
    killed: bool
    fault: str | None


Row = tuple[Work, int, list[Point]]
"""A command, how many changes it makes, and what became of its kills."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--points", type=int, default=200, help="how many kills")
    parser.add_argument("--seed", type=int, default=0, help="of their places")
    parser.add_argument("--at-once", type=int, default=2, help="how many commands at a time")
    given = parser.parse_args()
    began, rows = time.perf_counter(), list[Row]()
    try:
        with tempfile.TemporaryDirectory(prefix="gsdmsr-kills-") as root:
            Path(root, "data").mkdir()
            for work in works(Path(root, "data")):
                count = round(work.share * given.points)
                rows.append((work, *_kill(work, Path(root), count, given)))
    finally:  # Ctrl-C leaves the table of what is finished
        _print(rows, time.perf_counter() - began)
    sys.exit(any(point.fault for _, _, points in rows for point in points))


def _kill(work: Work, root: Path, count: int, given: argparse.Namespace) -> tuple[int, list[Point]]:
    """Return how many changes a command makes, and what became of ``count`` kills."""
    changes, expected = _undisturbed(work, root / "undisturbed" / "out")
    random = Random(f"{work.name}/{given.seed}")
    numbers = [int(changes * (i + random.random()) / count) + 1 for i in range(count)]

    def one(i: int) -> Point:
        out = root / f"{i}" / "out"
        point = _point(work, out, numbers[i], expected)
        shutil.rmtree(out.parent)
        if point.fault:
            print(f"{work.name}, change {point.number}: {point.fault}", file=sys.stderr, flush=True)
        return point

    with ThreadPoolExecutor(given.at_once) as pool:
        points = list(pool.map(one, range(count)))
    shutil.rmtree(root / "undisturbed")
    print(f"{work.name}: {count} points", file=sys.stderr, flush=True)
    return changes, points


def _undisturbed(work: Work, out: Path) -> tuple[int, Any]:
    out.parent.mkdir()
    work.lay(out)
    ended = killed.run(work.words(out), out)
    if ended.code:
        sys.exit(f"{work.name} fails by itself: {ended.said}")
    return ended.changes, work.content(out)


def _point(work: Work, out: Path, number: int, expected: Any) -> Point:
    out.parent.mkdir()
    work.lay(out)
    ended = killed.run(work.words(out), out, number)
    try:
        if not ended.killed and ended.code:
            raise AssertionError(f"it fails by itself: {ended.said}")
        work.check(out, expected)
        words = work.go_on(out)
        again = killed.run(words, out) if words is not None else None
        if again is not None and again.code:
            raise AssertionError(f"what goes on fails: {again.said}")
        if not work.alike(work.content(out), expected):
            raise AssertionError("another end than without a kill")
    except Exception:
        return Point(number, ended.killed, traceback.format_exc())
    return Point(number, ended.killed, None)


def _print(rows: list[Row], seconds: float) -> None:
    table = Table("command", "changes of the disk", "points", "killed", "sound after it")
    for work, changes, points in rows:
        sound = sum(point.fault is None for point in points)
        dead = sum(point.killed for point in points)
        table.add_row(work.name, f"{changes}", f"{len(points)}", f"{dead}", f"{sound}")
    console = Console()
    console.print(table)
    console.print(f"{sum(len(points) for *_, points in rows)} points in {seconds:.0f} s")


if __name__ == "__main__":
    main()
