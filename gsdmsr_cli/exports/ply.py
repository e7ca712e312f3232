"""Exports the splats at one moment as a 3DGS PLY file."""

from __future__ import annotations

from pathlib import Path

from gsdmsr_cli.errors import UsageError
from gsdmsr_cli.exports import ExportOptions, MovingSplats
from gsdmsr_cli.exports._ply import write_ply


def export(model: MovingSplats, target: Path, options: ExportOptions) -> list[Path]:
    """Write the splats at ``options.time`` to the file ``target``, replacing what was there.

    Raises:
        UsageError: ``target`` does not end in .ply, or several frames are asked for.
        DataError: a splat holds NaN or infinity, or the file cannot be written.
    """
    if options.frames:
        raise UsageError("--format ply shows one moment; give --time T, or take ply-sequence")
    if target.suffix.lower() != ".ply":
        raise UsageError(f"--format ply writes one file, but '{target}' does not end in .ply")
    write_ply(target, model.at(options.time))
    options.tell(1, 1)
    return [target]
