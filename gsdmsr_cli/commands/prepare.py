"""gsdmsr prepare: turns a video or pictures into a scene folder with cameras."""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from gsdmsr_cli.capture.options import Options
from gsdmsr_cli.capture.prepare import REPORT, Masks, convert, prepare, publish
from gsdmsr_cli.capture.report import rows
from gsdmsr_cli.capture.source import find_source
from gsdmsr_cli.capture.stages import Stages
from gsdmsr_cli.capture.write import NOTE
from gsdmsr_cli.commands._progress import progress_bar
from gsdmsr_cli.formats import recognised
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.files import read_json, write_json
from gsdmsr_cli.ground.progress import OnProgress

TIMINGS = "timings.json"
"""The one file of a scene that differs between runs on the same input."""


def run(
    given: Path,
    out: Path,
    kind: str | None,
    masks: Masks | None,
    options: Options,
    overwrite: bool,
    keep: bool,
    as_json: bool,
) -> None:
    """Write the scene folder ``out`` and print the report on its cameras.

    Args:
        given: a video, or a folder of pictures or videos.
        out: the scene folder.
        kind: what ``given`` is, where it is not plain.
        masks: of what moves.
        options: how the scene is made.
        overwrite: whether ``out`` may hold an earlier scene, which is replaced.
        keep: whether stages are kept for a run with other options.
        as_json: whether one JSON object is printed instead of a table.

    Raises:
        UsageError: ``out`` is in use.
        DataError: what was given cannot be used, or the scene not be written.
        KeyboardInterrupt: Ctrl-C; what is finished is kept for the same command.
    """
    _refuse_used(out, overwrite)
    stages = Stages(out.with_name(f"{out.name}.stages"))
    stopwatch = _Stopwatch()
    try:
        if kind is None and recognised(given):
            _refuse_masks(given, masks, options)
            scene = convert(given, stages, stopwatch.show_progress)
        else:
            scene = prepare(
                find_source(given, kind), masks, options, stages, stopwatch.show_progress
            )
    except KeyboardInterrupt:
        if stages.root.is_dir():
            text = f"interrupted; finished stages are kept in {shlex.quote(str(stages.root))}"
            Console(stderr=True).out(f"{text} and the same command goes on", highlight=False)
        raise
    write_json(scene / TIMINGS, {"seconds": stopwatch.seconds, "given": str(given.resolve())})
    publish(scene, out)
    if not keep:
        stages.remove()
    note = read_json(out / NOTE)
    if as_json:
        Console().out(json.dumps(note | {"seconds": stopwatch.seconds}, indent=2), highlight=False)
        return
    if note["quality"] is not None:
        _show(note["quality"], out)
    console = Console()
    console.out(f"wrote {out} in {sum(stopwatch.seconds.values()):.0f} s", highlight=False)
    command = shlex.join(["gsdmsr", "train", "--data", str(out), "--out", "runs/" + out.name])
    console.out(f"next: {command}", highlight=False)


class _Stopwatch:
    """Shows a bar for every stage and remembers how long each took."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def show_progress(self, description: str) -> Iterator[OnProgress]:
        started = time.perf_counter()
        with progress_bar(description) as on_progress:
            yield on_progress
        self.seconds[description] = round(time.perf_counter() - started, 2)


def _refuse_masks(given: Path, masks: Masks | None, options: Options) -> None:
    """Raise UsageError if masks are to serve a data set whose cameras are known."""
    if masks is not None or options.auto_mask:
        raise UsageError(
            f"{given}: is a data set with cameras, for which masks do nothing; drop them, or find "
            "cameras anew with --format"
        )


def _refuse_used(out: Path, overwrite: bool) -> None:
    """Raise UsageError unless ``out`` is free or an earlier scene that may be replaced."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    ours = out.is_dir() and (out / NOTE).is_file() and "gsdmsr" in read_json(out / NOTE)
    if not ours:
        raise UsageError(f"{out}: exists and is no scene of prepare's; choose another --out")
    if not overwrite:
        raise UsageError(f"{out}: holds a scene already; give --overwrite or another --out")


def _show(quality: dict[str, Any], out: Path) -> None:
    console = Console()
    table = Table(show_header=False)
    for what, value in rows(quality):
        table.add_row(what, value)
    console.print(table)
    for warning in quality["warnings"]:
        console.out(f"warning: {warning}", highlight=False)
    console.out(f"the camera's path: {out / REPORT}", highlight=False)
