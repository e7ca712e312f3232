"""gsdmsr prepare: turns a video or pictures into a scene folder with cameras."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any

from rich.table import Table

from gsdmsr_cli.capture.options import Options
from gsdmsr_cli.capture.order import Order
from gsdmsr_cli.capture.prepare import Masks, convert, prepare
from gsdmsr_cli.capture.publish import (
    finish,
    is_free,
    is_scene,
    place_of,
    publish,
    require_own,
    restore,
    stages_of,
)
from gsdmsr_cli.capture.report import rows
from gsdmsr_cli.capture.second_masks import Standing
from gsdmsr_cli.capture.source import find_source
from gsdmsr_cli.capture.stages import Stages
from gsdmsr_cli.capture.write import NOTE, REPORT, TIMINGS
from gsdmsr_cli.commands._stages_display import StagesDisplay
from gsdmsr_cli.formats import recognised
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.files import read_json, write_json
from gsdmsr_cli.ground.locks import one_of_readers, sole_writer


def run(
    given: Path,
    out: Path,
    kind: str | None,
    masks: Masks | None,
    options: Options,
    overwrite: bool,
    keep: bool,
    masks_of: Path | None = None,
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
        masks_of: run of what stands still in ``given``, a scene, by which what moves is masked.

    Raises:
        UsageError: ``out`` is in use.
        DataError: what was given cannot be used, or the scene not be written; or another process
            writes or reads there.
        KeyboardInterrupt: Ctrl-C; what is finished is kept for the same command.
    """
    display = StagesDisplay()
    place = place_of(out)
    if place == given.resolve():
        raise UsageError(f"{out}: is INPUT; choose another --out")
    source = None if kind is None and recognised(given) else find_source(given, kind)
    if source is None:
        _refuse_masks(given, masks, options)
    elif masks_of is not None:
        raise UsageError(
            f"{given}: has no cameras yet, and --masks-of needs a scene that its run was trained "
            "on; prepare it without --masks-of first"
        )
    stages = Stages(stages_of(place))
    try:
        with ExitStack() as locks:
            standing = None if masks_of is None else locks.enter_context(_standing(masks_of, given))
            order = Order(given, kind, masks, options, None if standing is None else standing.key)
            _take_places(locks, out, place, stages)
            if not order.is_published(place, stages):
                _refuse_used(out, place, overwrite)
                if given.is_dir():
                    locks.enter_context(one_of_readers(given))
                scene = (
                    convert(given, stages, display.show, standing)
                    if source is None
                    else prepare(source, masks, options, stages, display.show)
                )
                publication = order.announce(stages)
                timings = {"seconds": display.seconds(), "given": str(given.resolve())}
                write_json(scene / TIMINGS, timings | publication)
                publish(scene, place)
            if not keep:
                stages.remove()
            order.conclude(stages)
    except KeyboardInterrupt:
        if stages.root.is_dir():
            text = f"interrupted; finished stages are kept in {shlex.quote(str(stages.root))}"
            say.note(f"{text} and the same command goes on")
        raise
    _tell(out, display.seconds())


def _standing(folder: Path, data: Path) -> AbstractContextManager[Standing]:
    # what draws is loaded only where something is drawn
    from gsdmsr_cli.commands._standing import open_standing

    return open_standing(folder, data)


def _take_places(locks: ExitStack, out: Path, place: Path, stages: Stages) -> None:
    """Hold all folders that are written; finish what a killed process has begun there."""
    if place.exists() and not place.is_dir():
        raise UsageError(f"{out}: exists and is no scene of prepare's; choose another --out")
    if place.is_dir():
        locks.enter_context(sole_writer(place))
    locks.enter_context(stages.held())
    try:
        restore(place)
        finish(place)
    except OSError as error:
        where, reason = error.filename or place, error.strerror or error
        raise DataError(f"{where}: cannot be written: {reason}; free space") from error


def _tell(out: Path, seconds: Mapping[str, float]) -> None:
    note = read_json(out / NOTE)
    command = shlex.join(["gsdmsr", "train", "--data", str(out), "--out", "runs/" + out.name])
    say.result(
        note | {"seconds": seconds, "next": command},
        *([] if note["quality"] is None else _shown(note["quality"], out)),
        f"wrote {out} in {sum(seconds.values()):.0f} s",
        f"next: {command}",
    )


def _refuse_masks(given: Path, masks: Masks | None, options: Options) -> None:
    """Raise UsageError if masks are to serve a data set whose cameras are known."""
    if masks is not None or options.auto_mask:
        raise UsageError(
            f"{given}: is a data set with cameras, for which masks do nothing; drop them, or find "
            "cameras anew with --format, or take --masks-of a run of what stands still in it"
        )


def _refuse_used(out: Path, place: Path, overwrite: bool) -> None:
    """Raise UsageError unless ``place`` is free or an earlier scene that may be replaced."""
    if is_free(place):
        return
    if not is_scene(place):
        raise UsageError(f"{out}: exists and is no scene of prepare's; choose another --out")
    if not overwrite:
        raise UsageError(f"{out}: holds a scene already; give --overwrite or another --out")
    require_own(place)


def _shown(quality: dict[str, Any], out: Path) -> list[Table | str]:
    """Return the report on the cameras for people."""
    table = Table(show_header=False)
    for what, value in rows(quality):
        table.add_row(what, value)
    warnings = [f"warning: {warning}" for warning in quality["warnings"]]
    return [table, *warnings, f"the camera's path: {out / REPORT}"]
