"""The commands that are killed: what lies there before, what must hold after, what goes on."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import films
import killed
import room
from datasets import write_dnerf

from gsdmsr_cli.benchmark.kills import same
from gsdmsr_cli.capture.publish import WORK, finish
from gsdmsr_cli.demo.synthetic import write_scene
from gsdmsr_cli.ground.files import leftovers
from gsdmsr_cli.runs import checkpoints
from gsdmsr_cli.runs.run import is_run, open_run

Words = list[object]


@dataclass(frozen=True)
class Work:
    """A command that writes a folder.

    Attributes:
        name: of the command, and what it is given.
        share: of all kills.
        words: the command, for the folder to write.
        lay: puts there what is there before.
        check: raises unless, after a kill, old or new is whole; is given what there is in the end.
        go_on: the command after a kill; None if all was done.
        content: what there is in the end.
        alike: whether two ends are the same.
    """

    name: str
    share: float
    words: Callable[[Path], Words]
    lay: Callable[[Path], object]
    check: Callable[[Path, Any], None]
    go_on: Callable[[Path], Words | None]
    content: Callable[[Path], Any]
    alike: Callable[[Any, Any], bool]


def works(root: Path) -> list[Work]:
    """Make small data in ``root``, and return what is done with it."""
    tiny, film = root / "tiny", root / "film.mp4"
    write_scene(tiny, size=48, train=12, val=3, test=4)
    room.write_film(film, room.film(room.walk(10)), fps=5)
    old = root / "old"
    killed.run(["prepare", write_dnerf(root / "before", train=2), "--out", old], old)
    video = "--frames", 10, "--max-side", 320
    return [
        _drawing(films.make_run(tiny, root / "run")),
        _preparing("a data set", 0.4, write_dnerf(root / "given"), old),
        _training(tiny),
        _preparing("a video", 0.05, film, old, *video),
    ]


def _training(data: Path) -> Work:
    """A training that saves after every step, and keeps two checkpoints."""
    often = "--set", "training.checkpoint_minutes=1e-6", "--keep", 2

    def words(out: Path) -> Words:
        length = "--steps", 8, "--downscale", 1
        return ["train", "--data", data, "--out", out, "--preset", "dnerf", *length, *often]

    def check(out: Path, _: Any) -> None:
        for path in checkpoints.kept(out):
            checkpoints.read(path)
        if _has_saved(out):
            assert open_run(out).load_whole()[1] is None

    def go_on(out: Path) -> Words | None:
        if not _has_saved(out):
            return [*words(out), *(["--overwrite"] if is_run(out) else [])]
        checkpoint = open_run(out).load()
        complete = checkpoint.progress >= 1 and open_run(out).account(checkpoint.step)
        return None if complete else [*words(out), "--resume"]

    def alike(found: Any, expected: Any) -> bool:
        return same(found[0], expected[0]) and found[1] == expected[1]

    def content(out: Path) -> Any:
        return open_run(out).load(), leftovers(out)

    return Work("train", 0.2, words, lambda out: None, check, go_on, content, alike)


def _has_saved(out: Path) -> bool:
    return is_run(out) and open_run(out).checkpoint_path.is_file()


def _drawing(run: Path) -> Work:
    def words(out: Path) -> Words:
        return ["render", run, *films.FILM, "--out", out]

    def check(out: Path, expected: Any) -> None:
        assert films.shown(out).items() <= expected[0].items()

    def content(out: Path) -> Any:
        return films.shown(out), films.names(out)

    return Work("render", 0.35, words, lambda out: None, check, words, content, _equal)


def _preparing(what: str, share: float, given: Path, old: Path, *options: object) -> Work:
    """Making a scene in place of an earlier one."""

    def words(out: Path) -> Words:
        return ["prepare", given, "--out", out, "--overwrite", *options]

    def check(out: Path, expected: Any) -> None:
        copy = out.parent / "copy" / out.name
        shutil.copytree(out, copy)
        if (copy / WORK).is_dir():
            finish(copy)
        assert _files(copy) in (_files(old), expected[0])
        shutil.rmtree(copy.parent)

    return Work(
        f"prepare {what}", share, words, lambda out: shutil.copytree(old, out), check, words,
        lambda out: (_files(out), films.names(out.parent)), _equal,
    )  # fmt: skip


def _files(folder: Path) -> dict[str, bytes]:
    """Return all files but those that tell times, and so differ."""
    found = [path for path in folder.rglob("*") if path.is_file() and path.name not in _TELL_TIMES]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in found}


_TELL_TIMES = {"timings.json", "report.html"}


def _equal(found: Any, expected: Any) -> bool:
    return bool(found == expected)
