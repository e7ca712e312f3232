"""Writes everything that moves as one small file, which ``gsdmsr`` and web pages play."""

from __future__ import annotations

from pathlib import Path

from gsdmsr_cli.exports._facts import Facts
from gsdmsr_cli.exports._moment import require_suffix, write_bytes
from gsdmsr_cli.exports._played import Options, file_of, lost
from gsdmsr_cli.exports._source import Source
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.moving.container import SUFFIX

BAKES = True

__all__ = ["BAKES", "Options", "lost", "write"]


def write(
    source: Source, facts: Facts, options: Options, out: Path, on_progress: OnProgress
) -> list[Path]:
    """Write the file, as docs/file-format.md describes it.

    Raises:
        UsageError: ``out`` does not end in .dsplat, or something is asked for that it has not.
        DataError: a splat holds NaN or infinity, the finest coding loses too much, or the file
            cannot be written.
    """
    require_suffix(out, "moving", SUFFIX)
    return write_bytes(out, file_of(source, facts, options, on_progress))
