"""The folder of ``gsdmsr make``: what it is made of, and which stages are done."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.files import read_json, write_json

NOTE = "make.json"
"""File that marks a folder as one of make's and says what it is made of."""


@dataclass(frozen=True)
class Request:
    """The options of ``gsdmsr make``.

    Attributes:
        given: a video, a folder of pictures or videos, or a scene with cameras.
        out: folder to write.
        budget: wall time of the training.
        preset: the preset that is named, or None.
        overrides: "a.b=value" texts over the preset.
        frames, max_side: see ``capture.options.Options``.
        device: "auto", "cpu" or "cuda".
    """

    given: Path
    out: Path
    budget: str = "9m"
    preset: str | None = None
    overrides: tuple[str, ...] = ()
    frames: int = 240
    max_side: int = 1600
    device: str = "auto"


class Making:
    """What stands in a folder's note; another order than before is refused."""

    def __init__(self, request: Request) -> None:
        self._request = request
        self._path = request.out / NOTE
        self._done: dict[str, str] = {}

    def claim(self) -> None:
        """Make the folder, unless something else lies there.

        Raises:
            UsageError: it holds something else, or what was made of something else.
            DataError: the input is missing, or the folder cannot be made.
        """
        given, out = self._request.given, self._request.out
        if not given.exists():
            raise DataError(f"{given}: not found; give a video, or a folder of pictures or videos")
        if out.exists() and not out.is_dir():
            raise UsageError(f"{out}: is a file; --out names a folder")
        if out.is_dir() and any(out.iterdir()) and not self._path.is_file():
            raise UsageError(f"{out}: holds something else; choose another --out")
        if out.resolve() == given.resolve() or out.resolve() in given.resolve().parents:
            raise UsageError(f"{out}: holds INPUT; choose another --out")
        if self._path.is_file():
            self._require_same(read_json(self._path))
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            reason = error.strerror or error
            raise DataError(f"{out}: cannot be made: {reason}; choose another --out") from error

    def begin(self) -> None:
        """Read which stages are done, now that nobody else writes; the first time write the note.

        Raises:
            UsageError: meanwhile somebody has begun to make something else there.
            DataError: the note cannot be read or written.
        """
        if self._path.is_file():
            found = read_json(self._path)
            self._require_same(found)
            self._done = dict(found["done"])
        else:
            self._write()

    def is_to_do(self, stage: str, checkpoint: str, left: Path) -> bool:
        """Return whether a stage has not been finished for a checkpoint, named by its hash.

        Nor is it if what it has ``left`` is not there any more.
        """
        return self._done.get(stage) != checkpoint or not left.exists()

    def done(self, stage: str, checkpoint: str) -> None:
        """Note that it has."""
        self._done[stage] = checkpoint
        self._write()

    def _write(self) -> None:
        write_json(self._path, {"order": self._order(), "done": self._done})

    def _require_same(self, found: dict[str, Any]) -> None:
        own, there = self._order(), found.get("order", {})
        for name, value in own.items():
            if there.get(name) != value:
                raise UsageError(
                    f"{self._request.out}: was made with {name} = {there.get(name)!r}, not "
                    f"{value!r}; only --budget may change: choose another --out"
                )

    def _order(self) -> dict[str, Any]:
        """Return all that may not change but the length of the training, as plain JSON."""
        r = self._request
        return {
            "input": str(r.given.resolve()), "files": [list(seen) for seen in _seen(r.given)],
            "preset": r.preset, "set": list(r.overrides), "frames": r.frames,
            "max_side": r.max_side,
        }  # fmt: skip


def _seen(given: Path) -> Iterator[tuple[str, int, int]]:
    """Yield names, sizes and times of a video, or of what lies in a folder at once."""
    for path in [given, *sorted(given.iterdir())] if given.is_dir() else [given]:
        stat = path.stat()
        yield path.name, stat.st_size, stat.st_mtime_ns
