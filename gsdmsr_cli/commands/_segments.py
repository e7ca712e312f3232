"""Trains a capture whose time is cut into segments: what stands still, each segment, all joined.

Every part is one ``gsdmsr train`` in a process of its own, here or on a worker of Ray. What is
finished is not done again, and what was cut short goes on.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

from rich.table import Table

from gsdmsr_cli.calling.calls import Line, call, call_side_by_side
from gsdmsr_cli.calling.on_ray import connected, needs_of, require_workers
from gsdmsr_cli.calling.ray_calls import call_on_ray
from gsdmsr_cli.commands._beginning import Anew, resumed_options
from gsdmsr_cli.commands._choice import Choice
from gsdmsr_cli.commands._preparing import read
from gsdmsr_cli.commands._segment_work import Work
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.files import read_json, write_json
from gsdmsr_cli.ground.locks import one_of_readers, sole_writer
from gsdmsr_cli.runs import segments as parts
from gsdmsr_cli.runs.checkpoints import SCHEMA
from gsdmsr_cli.runs.run import is_run, open_run
from gsdmsr_cli.training.request import Request

LEAST = 2
"""Moments that a segment must have, or nothing would move in it."""

_Works = Mapping[Path, Callable[[], Iterator[Line]]]
"""What is left to do of each part, by the file that what it shows may be added to."""


def is_cut(request: Request) -> bool:
    """Return whether a training is one of segments.

    Raises:
        UsageError: an option does not exist or is out of range.
        DataError: the run that is to go on is damaged.
    """
    if request.resume:
        return is_run(request.out) and open_run(request.out).preset.segments.several
    return Choice(request.preset, request.config, request.overrides).check().segments.several


def train_cut(request: Request) -> None:
    """Train all segments and write a run folder that joins them, or say what would be done.

    Raises:
        UsageError: an option does not exist, cannot be changed when resuming, or does not go
            together with segments.
        DataError: the data or the run folder cannot be used.
        GsdmsrError: the training of a part has failed; its own message stands above.
        KeyboardInterrupt: Ctrl-C; the same command with ``--resume`` goes on.
    """
    if request.view_port is not None:
        raise UsageError(
            "--view shows one training, and --segments makes several; drop it, and look at one by "
            f"gsdmsr view {parts.folder_of(request.out, 0)}"
        )
    with ExitStack() as held:
        there = request.out.is_dir()
        if there:
            held.enter_context(sole_writer(request.out))
        held.enter_context(one_of_readers(request.data))
        work = _begin(request, held)
        if request.dry_run:
            _show_plan(work)
            return
        if not there:
            held.enter_context(sole_writer(request.out))
        work.open_folder()
        try:
            _train(work)
        except KeyboardInterrupt:
            again = ("gsdmsr", "train", "--data", str(request.data), "--out", str(request.out))
            say.note(f"interrupted; continue with: {shlex.join([*again, '--resume'])}")
            raise
        account = _join(work)
    splats, folder = account["splats"], request.out
    say.note(f"trained {len(work.segments)} segments to {splats} splats: {folder}")
    say.result({"run": str(folder), "preset": work.name, "reason": work.reason, **account})


def _begin(request: Request, held: ExitStack) -> Work:
    """Return what is to be done, once the data has been read.

    Raises:
        UsageError, DataError: see ``train_cut``.
    """
    if request.resume:
        earlier = open_run(request.out)
        options = resumed_options(earlier, request)
        scene = earlier.part_of(read(request))
        work = Work(request, earlier, options, earlier.name, earlier.reason, scene)
    else:
        anew = Anew(request, held)
        scene = anew.suit(read(request))
        work = Work(request, None, anew.options, anew.name, anew.reason, scene)
    for segment in work.segments:
        if work.moments(segment) < LEAST:
            raise UsageError(
                f"segments.count is {work.options.segments.count}; allowed: fewer, since from "
                f"{segment.start:.3g} to {segment.end:.3g} of the time there are "
                f"{work.moments(segment)} of the {len(scene.train_times)} moments of {scene.root}, "
                f"and a segment needs {LEAST}"
            )
    return work


def _train(work: Work) -> None:
    """Train the parts, as far as that is still to do."""
    if work.options.segments.static_share:
        folder = parts.static_of(work.root)
        say.note(f"what stands still, from all moments: {folder}")
        _call({_log(folder): work.left_of_static}, work)
    logs = [_log(parts.folder_of(work.root, number)) for number in range(len(work.segments))]
    works = {log: partial(work.left_of, number) for number, log in enumerate(logs)}
    if work.request.workers is not None:
        _call(works, work)
        return
    step = work.request.jobs
    for first in range(0, len(logs), step):
        some = {log: works[log] for log in logs[first : first + step]}
        for number in range(first, first + len(some)):
            segment = work.segments[number]
            say.note(
                f"segment {number + 1} of {len(logs)}, time {segment.start:.3g} to "
                f"{segment.end:.3g}: {parts.folder_of(work.root, number)}"
            )
        _call(some, work)


def _log(folder: Path) -> Path:
    return folder.with_name(f"{folder.name}.log")


def _call(works: _Works, work: Work) -> None:
    """Run what is left of some parts: one by one in view, side by side, or on workers of Ray."""
    request = work.request
    if request.workers is not None:
        with connected(request.workers) as ray, needs_of(work.root, [work.data]) as needs:
            require_workers(ray, needs)
            call_on_ray(ray, works, work.threads, needs, lambda log: say.note(f"ended: {log}"))
    elif request.jobs > 1:
        call_side_by_side({log: left() for log, left in works.items()}, work.threads)
    else:
        for left in works.values():
            for line in left():
                call(*line)


def _join(work: Work) -> dict[str, Any]:
    """Write the checkpoint that joins all segments, and return what the trainings took."""
    runs = [open_run(parts.folder_of(work.root, number)) for number in range(len(work.segments))]
    still = None
    if work.options.segments.static_share:
        still = open_run(parts.static_of(work.root))
    loaded = [run.load_model() for run in runs]
    of = [(run.facts, checkpoint) for run, (_, checkpoint) in zip(runs, loaded, strict=True)]
    before = None if still is None else still.load()
    joined = parts.join(work.segments, [model for model, _ in loaded], of, before)
    folder = open_run(work.root)
    folder.save(joined)
    accounts = [read_json(run.training_path) for run in runs]
    every = [*accounts, *([] if still is None else [read_json(still.training_path)])]
    account = {
        **accounts[0],
        "schema": SCHEMA,
        **{key: round(sum(a[key] for a in every), 3) for key in ("load_s", "compile_s", "train_s")},
        "steps": joined.step,
        "progress": joined.progress,
        "splats": sum(account["splats"] for account in accounts),
        "peak_rss_mib": max(account["peak_rss_mib"] for account in every),
        "segments": len(runs),
        "segments_train_s": [account["train_s"] for account in accounts],
    }
    write_json(folder.training_path, account)
    return account


def _show_plan(work: Work) -> None:
    training, share = work.options.training, work.options.segments.static_share
    each = training.budget or f"{training.steps} steps"
    table = Table("segment", "time", "moments", "length", title=f"preset {work.name}")
    if share:
        table.add_row(
            "what stands still", "all", str(len(work.scene.train_times)), f"{share:g} of it"
        )
    rows = []
    for number, segment in enumerate(work.segments):
        ends = segment.start, segment.end
        rows.append({"start": ends[0], "end": ends[1], "moments": work.moments(segment)})
        table.add_row(
            str(number), f"{ends[0]:.3g} to {ends[1]:.3g}", str(rows[-1]["moments"]), each
        )
    document = {
        "dry_run": True, "preset": work.name, "reason": work.reason, "length": each,
        "static_share": share, "segments": rows,
    }  # fmt: skip
    say.result(document, table, "nothing has been written")
