"""Folders of working files with a marker inside: only what carries it is ever removed."""

from __future__ import annotations

import shutil
from pathlib import Path

MARKER = ".gsdmsr"
"""Empty file in folders that prepare has made for its own use."""


def mark(folder: Path) -> None:
    """Make the folder, unless it is there, and say that it is prepare's.

    Raises:
        OSError: it cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / MARKER).touch()


def is_marked(folder: Path) -> bool:
    """Return whether the folder is one of prepare's."""
    return (folder / MARKER).is_file()


def remove_marked(folder: Path) -> None:
    """Remove a marked folder and all in it, the marker last; others, and what fails, are left."""
    if not is_marked(folder):
        return
    for entry in folder.iterdir():
        if entry.name != MARKER:
            remove(entry)
    remove_marker(folder)


def remove_marker(folder: Path) -> None:
    """Remove the marker of a folder, and with it the folder, unless something else is in it."""
    if [entry.name for entry in folder.iterdir()] == [MARKER]:
        (folder / MARKER).unlink()
        folder.rmdir()


def remove(path: Path) -> None:
    """Remove a file, a link or a folder with all in it, as far as that can be done."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
