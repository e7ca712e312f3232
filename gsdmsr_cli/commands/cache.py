"""gsdmsr cache: says what is kept to save time later, and removes it if told to."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from gsdmsr_cli.backends.cpu import jit
from gsdmsr_cli.evaluation.lpips import weights_in_hub
from gsdmsr_cli.formats import kept_frames
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.machine import cache_home

_NAME = re.compile(r"[0-9a-f]{16}")
"""What folders of kernels and frames are called: a hash of their sources."""

KERNELS, GPU_KERNELS, FRAMES, WEIGHTS = "kernels", "GPU kernels", "frames", "LPIPS weights"


@dataclass(frozen=True)
class Kept:
    """Something that is kept.

    Attributes:
        kind: what it is.
        path: file or folder.
        size: of all in it [bytes].
    """

    kind: str
    path: Path
    size: int


def run(clear: bool = False, weights: bool = False, frames: bool = False) -> None:
    """Print what is kept, or what was removed of it.

    Args:
        clear: remove kernels; those of a command that is running are compiled again by the next.
        weights: remove the weights of LPIPS as well.
        frames: remove the frames of videos as well; the next command that needs them decodes them.

    Raises:
        DataError: something cannot be removed.
    """
    kept = list(find_kept())
    spared = {kind for kind, asked in ((WEIGHTS, weights), (FRAMES, frames)) if not asked}
    gone = [entry for entry in kept if clear and entry.kind not in spared]
    for entry in gone:
        _remove(entry.path)
    total = sum(entry.size for entry in (gone if clear else kept))
    document = {
        "kept": [_plain(entry) for entry in kept if entry not in gone],
        "removed": [_plain(entry) for entry in gone],
    }
    text = f"{'removed' if clear else 'kept'}: {total / 1e6:.1f} MB"
    say.result(document, _table(gone if clear else kept), text)


def find_kept() -> Iterator[Kept]:
    """Yield what is there: kernels of all versions, frames, and weights in torch's folder."""
    home = cache_home()
    places = (
        (KERNELS, jit.HERE / "__pycache__"), (KERNELS, home), (GPU_KERNELS, home / "cuda"),
        (FRAMES, kept_frames()),
    )  # fmt: skip
    for kind, place in places:
        for path in sorted(place.iterdir()) if place.is_dir() else ():
            if _NAME.fullmatch(path.name) and path.is_dir() and not path.is_symlink():
                yield Kept(kind, path, _size(path))
    for path in weights_in_hub():
        yield Kept(WEIGHTS, path, path.stat().st_size)


def _size(folder: Path) -> int:
    return sum(path.lstat().st_size for path in folder.rglob("*") if path.is_file())


def _remove(path: Path) -> None:
    try:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    except OSError as error:
        raise DataError(f"{path}: cannot be removed: {error.strerror or error}") from error


def _plain(entry: Kept) -> dict[str, object]:
    return {"kind": entry.kind, "path": os.fspath(entry.path), "bytes": entry.size}


def _table(entries: list[Kept]) -> Table:
    table = Table("what", "where", "MB")
    table.columns[1].overflow = "fold"
    table.columns[2].justify = "right"
    for entry in entries:
        table.add_row(entry.kind, escape(str(entry.path)), f"{entry.size / 1e6:.1f}")
    return table
