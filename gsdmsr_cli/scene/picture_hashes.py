"""Hashes of the files of a scene's views, by which changed pictures are noticed.

A sample of a file is its size with its first, middle and last block: what is saved again, cropped
or overwritten differs there, and little is read of many pictures. Whole hashes read everything.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.limits import cores

BLOCK = 4096
"""Bytes of each of the three blocks of a sample."""

_DIGITS = 16
_CHUNK = 1 << 20

Hashes = Mapping[str, str]
"""By the name of a file, relative to the scene's folder: 16 hexadecimal digits of a SHA-256."""


def sampled(root: Path, paths: Iterable[Path], decoded: Path | None = None) -> Hashes:
    """Return the hashes of samples of the files.

    Args:
        root: the scene's folder.
        paths: of the files.
        decoded: a folder that stands for the scene's, for the files in it.

    Raises:
        DataError: one cannot be read.
    """
    return {_name(root, decoded, path): _hash(path, _sample) for path in paths}


def whole(root: Path, paths: Iterable[Path], decoded: Path | None = None) -> Hashes:
    """Return the hashes of the whole files; see ``sampled``.

    Raises:
        DataError: one cannot be read.
    """
    files = list(paths)
    with ThreadPoolExecutor(cores()) as pool:
        found = pool.map(partial(_hash, read=_all), files)
        return dict(zip((_name(root, decoded, path) for path in files), found, strict=True))


def digest(hashes: Hashes) -> str:
    """Return one hash of all."""
    return hashlib.sha256(json.dumps(dict(sorted(hashes.items()))).encode()).hexdigest()[:_DIGITS]


def difference(found: Hashes, expected: Hashes) -> str | None:
    """Return a clause that names the first file in which two scenes differ, None if in none."""
    shared = found.keys() & expected.keys()
    changed = sorted(name for name in shared if found[name] != expected[name])
    if changed:
        others = f" and {len(changed) - 1} more have" if len(changed) > 1 else " has"
        return f"{changed[0]}{others} changed"
    odd = sorted(found.keys() ^ expected.keys())
    return f"{odd[0]} is {'new' if odd[0] in found else 'not there any more'}" if odd else None


def _name(root: Path, decoded: Path | None, path: Path) -> str:
    above = decoded if decoded is not None and path.is_relative_to(decoded) else root
    return Path(os.path.relpath(path, above)).as_posix()


def _hash(path: Path, read: Callable[[Path], Iterable[bytes]]) -> str:
    state = hashlib.sha256()
    try:
        for part in read(path):
            state.update(part)
    except OSError as error:
        raise DataError(f"{path}: cannot be read: {error.strerror or error}") from error
    return state.hexdigest()[:_DIGITS]


def _sample(path: Path) -> Iterable[bytes]:
    with path.open("rb", buffering=0) as file:
        size = os.fstat(file.fileno()).st_size
        yield f"{size}\0".encode()
        for place in (0, size // 2, max(size - BLOCK, 0)):
            file.seek(place)
            yield file.read(BLOCK)


def _all(path: Path) -> Iterable[bytes]:
    with path.open("rb") as file:
        while chunk := file.read(_CHUNK):
            yield chunk
