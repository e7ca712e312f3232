"""Recognises the input of ``gsdmsr prepare``: videos, pictures, or the videos of a rig."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from pathlib import Path

from gsdmsr_cli.ground.errors import DataError

VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".3gp", ".mts", ".m2ts", ".mpg")
PICTURES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")

_CHUNK = 1 << 20


@dataclass(frozen=True)
class Source:
    """Where frames come from.

    Attributes:
        kind: "video", "images" or "rig".
        root: the file or folder that was given.
        files: the videos or pictures, in the order of their names.
    """

    kind: str
    root: Path
    files: tuple[Path, ...]

    def digest(self) -> str:
        """Return the SHA-256 over the files' names and contents."""
        digest = hashlib.sha256()
        for path in self.files:
            digest.update(f"{path.name}\0{path.stat().st_size}\0".encode())
            with path.open("rb") as file:
                while chunk := file.read(_CHUNK):
                    digest.update(chunk)
        return digest.hexdigest()


def find_source(path: Path, kind: str | None = None) -> Source:
    """Recognise what ``path`` holds, or take it for a ``kind``.

    Raises:
        DataError: there is nothing there, or nothing of that kind, or more than one kind.
    """
    if kind == "rig":
        return replace(find_source(path, "video"), kind="rig")
    if path.is_file():
        if kind == "images":
            raise DataError(f"{path}: is a file; --format images takes a folder of pictures")
        return Source("video", path, (path,))
    if not path.is_dir():
        raise DataError(f"{path}: does not exist; give a video or a folder of pictures or videos")
    found = {"video": _listed(path, VIDEOS), "images": _listed(path, PICTURES)}
    kinds = [name for name, files in found.items() if files and kind in (None, name)]
    if len(kinds) > 1:
        raise DataError(
            f"{path}: holds {len(found['video'])} videos and {len(found['images'])} pictures; "
            "choose with --format video or --format images"
        )
    if not kinds:
        wanted = {"video": "videos", "images": "pictures"}.get(kind or "", "pictures or videos")
        known = " ".join({"video": VIDEOS, "images": PICTURES}.get(kind or "", VIDEOS + PICTURES))
        raise DataError(f"{path}: holds no {wanted}; their names end in one of {known}")
    return Source(kinds[0], path, tuple(found[kinds[0]]))


def _listed(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    files = (path for path in folder.iterdir() if path.suffix.lower() in suffixes)
    return sorted(path for path in files if path.is_file() and not path.name.startswith("."))
