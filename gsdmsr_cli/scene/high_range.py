"""Tells which videos have a high dynamic range, whose colours look flat as they are stored."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from gsdmsr_cli.scene.native import load_av
from gsdmsr_cli.scene.video import ALLOWED

_TRANSFERS = {16: "PQ", 18: "HLG"}
"""Transfer functions of high dynamic range by their numbers in ITU-T H.273, table 3."""


def high_ranges(paths: Iterable[Path]) -> list[tuple[str, str]]:
    """Return the names of the videos that have a high dynamic range, and which, "PQ" or "HLG"."""
    found = ((path.name, _high_range(path)) for path in paths)
    return [(name, kind) for name, kind in found if kind is not None]


def _high_range(path: Path) -> str | None:
    av = load_av()
    try:
        with av.open(str(path), options=ALLOWED) as file:
            return _TRANSFERS.get(file.streams.video[0].codec_context.color_trc)
    except (av.FFmpegError, OSError, IndexError, AttributeError, ValueError, MemoryError):
        return None  # whoever reads the video says what is wrong with it
