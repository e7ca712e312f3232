"""Writes the moving splats as a folder of 3DGS PLY files, one per moment."""

from __future__ import annotations

import re
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from gsdmsr_cli import __version__
from gsdmsr_cli.exports._facts import Facts
from gsdmsr_cli.exports._ply import write_ply
from gsdmsr_cli.exports._source import Source
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.files import leftovers, read_json, write_json
from gsdmsr_cli.ground.locks import sole_writer
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.options.strict import require

PREFIX = "frame"

NOTE = "ply-sequence.json"
"""Names the frames that have been written here, which another export may replace."""

PART = ".ply-sequence.part"
"""Folder for frames until all have been written."""


@dataclass(frozen=True)
class Options:
    """Settings: either of them.

    Attributes:
        frames: number of moments, evenly over [0, 1], both ends included; a single one is 0.
        time: the only moment, in [0, 1].
    """

    frames: int | None = None
    time: float | None = None

    def __post_init__(self) -> None:
        require(self, "frames", self.frames is None or self.frames >= 1, "1 or more")
        in_range = self.time is None or 0 <= self.time <= 1
        require(self, "time", in_range, "0 to 1, from the first frame to the last")
        if self.time is not None and self.frames is not None:
            raise UsageError("--time and --frames are both given; drop one")
        if self.time is None and self.frames is None:
            raise UsageError(
                "--format ply-sequence needs --frames N, the number of moments to write"
            )

    def moments(self) -> list[float]:
        """Return the moments in order, each in [0, 1]."""
        if self.time is not None:
            return [self.time]
        count = self.frames or 0  # 1 or more, as there is no time
        return [i / max(count - 1, 1) for i in range(count)]


def lost(source: Source, options: Options) -> list[str]:
    """Return what the files cannot carry."""
    return source.lost_at(options.moments()[0])


def write(
    source: Source, facts: Facts, options: Options, out: Path, on_progress: OnProgress
) -> list[Path]:
    """Write frame0001.ply, frame0002.ply, ... into the folder ``out``, in the order of time.

    The moments are those of ``options.moments()``. Viewers such as SuperSplat play every file of
    the prefix, so frames of anything else are refused rather than mixed in or replaced. Frames
    appear together, after the last has been written.

    Raises:
        DataError: ``out`` is a file or holds other frames, another process writes there, a splat
            holds NaN or infinity, or a file cannot be written.
    """
    moments = options.moments()
    digits = max(4, len(str(len(moments))))
    names = [f"{PREFIX}{i:0{digits}d}.ply" for i in range(1, len(moments) + 1)]
    _refuse_others(out, names)
    with sole_writer(out):
        _refuse_others(out, names)
        part = out / PART
        try:
            _remove(part)
            for done, (name, time) in enumerate(zip(names, moments, strict=True), start=1):
                write_ply(part / name, source.at(time))
                on_progress(done, len(names))
            _move_up(part, out, names)
        finally:
            _remove(part)
    return [out / name for name in names]


def _move_up(part: Path, out: Path, names: list[str]) -> None:
    """Move all frames to their places, and say which are there and when all of them are."""
    note = {"gsdmsr": __version__, "whole": False, "frames": names}
    write_json(out / NOTE, note)
    try:
        for name in names:
            (part / name).replace(out / name)
    except OSError as error:
        reason = error.strerror or error
        raise DataError(f"{out}: cannot be written: {reason}; free space") from error
    write_json(out / NOTE, note | {"whole": True})


def _remove(part: Path) -> None:
    """Remove the folder of frames that have not been moved up, but nothing else in it."""
    with suppress(OSError):
        for path in (*part.glob(f"{PREFIX}*.ply"), *leftovers(part)):
            path.unlink()
        part.rmdir()


def _refuse_others(folder: Path, names: list[str]) -> None:
    """Raise DataError if ``folder`` is no folder or holds frames that are not to be replaced."""
    try:
        present = {path.name for path in folder.iterdir()}
    except FileNotFoundError:
        return
    except OSError as error:
        reason = error.strerror or error
        raise DataError(f"cannot use {folder}: {reason}; --out must name a folder") from error
    frames = {name for name in present if re.fullmatch(rf"{PREFIX}\d+\.ply", name)}
    own = set(_noted(folder)) & set(names)
    if others := sorted(frames - own):
        raise DataError(
            f"{folder} holds {len(others)} frames of another sequence, {others[0]} the first; "
            "empty it or choose another --out"
        )


def _noted(folder: Path) -> list[str]:
    """Return the frames that an earlier export has written there, by its note."""
    if not (folder / NOTE).is_file():
        return []
    note = read_json(folder / NOTE)
    return list(map(str, note.get("frames", []))) if "gsdmsr" in note else []
