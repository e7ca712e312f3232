"""Exports the moving splats as a folder of 3DGS PLY files, one per moment."""

from __future__ import annotations

import re
from pathlib import Path

from gsdmsr_cli.errors import DataError, UsageError
from gsdmsr_cli.exports import ExportOptions, MovingSplats
from gsdmsr_cli.exports._ply import write_ply

PREFIX = "frame"


def export(model: MovingSplats, target: Path, options: ExportOptions) -> list[Path]:
    """Write frame0001.ply, frame0002.ply, ... into the folder ``target``, in the order of time.

    The moments are those of ``options.moments()``. Viewers such as SuperSplat play every file of
    the prefix, so frames left from a longer sequence are refused rather than mixed in.

    Raises:
        UsageError: ``options`` name no moment.
        DataError: ``target`` is a file or holds other frames, a splat holds NaN or infinity, or a
            file cannot be written.
    """
    moments = options.moments()
    if not moments:
        raise UsageError("--format ply-sequence needs --frames N, the number of moments to write")
    digits = max(4, len(str(len(moments))))
    paths = [target / f"{PREFIX}{i:0{digits}d}.ply" for i in range(1, len(moments) + 1)]
    _refuse_leftovers(target, paths)
    for done, (path, time) in enumerate(zip(paths, moments, strict=True), start=1):
        write_ply(path, model.at(time))
        options.tell(done, len(paths))
    return paths


def _refuse_leftovers(folder: Path, paths: list[Path]) -> None:
    """Raise DataError if ``folder`` is no folder or holds frames besides ``paths``."""
    try:
        present = {path.name for path in folder.iterdir()}
    except FileNotFoundError:
        return
    except OSError as error:
        reason = error.strerror or error
        raise DataError(f"cannot use {folder}: {reason}; --out must name a folder") from error
    frames = {name for name in present if re.fullmatch(rf"{PREFIX}\d+\.ply", name)}
    if others := sorted(frames - {path.name for path in paths}):
        raise DataError(
            f"{folder} holds {len(others)} frames of another sequence, {others[0]} the first; "
            "empty it or choose another --out"
        )
