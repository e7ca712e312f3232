"""Writes the splats at one moment as a 3DGS PLY file."""

from __future__ import annotations

from pathlib import Path

from gsdmsr_cli.exports._facts import Facts
from gsdmsr_cli.exports._moment import Options, require_suffix
from gsdmsr_cli.exports._ply import write_ply
from gsdmsr_cli.exports._source import Source
from gsdmsr_cli.ground.progress import OnProgress

__all__ = ["Options", "lost", "write"]


def lost(source: Source, options: Options) -> list[str]:
    """Return what the file cannot carry; the motion is not lost, since one moment is asked for."""
    return source.lost_at(options.time)


def write(
    source: Source, facts: Facts, options: Options, out: Path, on_progress: OnProgress
) -> list[Path]:
    """Write the splats at ``options.time`` to the file ``out``, replacing what was there.

    Raises:
        UsageError: ``out`` does not end in .ply.
        DataError: a splat holds NaN or infinity, or the file cannot be written.
    """
    require_suffix(out, "ply", ".ply")
    write_ply(out, source.at(options.time))
    on_progress(1, 1)
    return [out]
