"""Puts a finished scene where it is to lie, in place of an earlier one, whole at every moment.

A folder that is not there yet appears by a rename. One that is there, which may be a mount or be
reached by a link, stays and is filled: the new scene is first brought whole into a folder of work
inside it, then what prepare has written before is moved out of its way, then the new is moved up,
by a handful of renames. Whoever comes after a kill in between finishes that (``finish``).
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from gsdmsr_cli.capture.convert import FOLDERS
from gsdmsr_cli.capture.marked import is_marked, mark, remove_marked
from gsdmsr_cli.capture.write import NOTE, POINTS, REPORT, TIMINGS
from gsdmsr_cli.formats.nerfstudio import MASK_KEYS, SIGN
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.files import can_be_written, read_json, remove_leftovers

_FILES = (SIGN, NOTE, POINTS, REPORT, TIMINGS)
_FOLDERS = ("images", *sorted(FOLDERS.values()))
"""All that prepare writes into a scene folder. What is there besides is somebody else's."""

WORK, STAGES = ".gsdmsr-publish", ".gsdmsr-stages"
_PART, _NEW, _PLACING, _OLD = "part", "new", "placing", "old"
"""Inside the folder of work: a copy that is being made; the new scene, whole; the same after the
earlier one has been moved away; the earlier one."""

_OF_DISKS = "lost+found"
"""Folder that a freshly made file system has."""


def place_of(out: Path) -> Path:
    """Return the folder that ``out`` names, itself or through links."""
    try:
        return out.resolve()
    except (OSError, RuntimeError) as error:
        raise UsageError(f"{out}: is a link that leads nowhere; choose another --out") from error


def stages_of(place: Path) -> Path:
    """Return the folder for the stages of a scene: beside it, or inside where that cannot be."""
    if place.is_dir() and (os.path.ismount(place) or not can_be_written(place.parent)):
        return place / STAGES
    return place.with_name(f"{place.name}.stages")


def is_scene(folder: Path) -> bool:
    """Return whether the folder carries the marker of prepare's scenes."""
    try:
        return "gsdmsr" in read_json(folder / NOTE)
    except DataError:
        return False


def is_free(place: Path) -> bool:
    """Return whether nothing lies there but what prepare, or a file system, needs for itself."""
    ours = {WORK, STAGES, _OF_DISKS}
    return not place.exists() or (
        place.is_dir() and all(entry.name in ours for entry in place.iterdir())
    )


def require_own(place: Path) -> None:
    """Raise UsageError if replacing the scene would take something else away with it."""
    foreign = next(_foreign(place), None)
    if foreign is not None:
        raise UsageError(
            f"{foreign}: lies in the scene but is not of prepare, and --overwrite would remove it; "
            "move it away or choose another --out"
        )


def _foreign(place: Path) -> Iterator[Path]:
    """Yield what has a place that a new scene needs and is not of the scene that is there."""
    known = _pictures_of(place)
    for name in _FILES:
        path = place / name
        if path.is_symlink() or (path.exists() and not path.is_file()):
            yield path
    for name in _FOLDERS:
        folder = place / name
        if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
            yield folder
            continue
        for path in sorted(folder.rglob("*")):
            if not path.is_dir() and path.relative_to(place).as_posix() not in known:
                yield path


def _pictures_of(place: Path) -> set[str]:
    """Return the files of pictures and masks that the scene's description names."""
    try:
        frames = read_json(place / SIGN)["frames"]
        keys = "file_path", *MASK_KEYS.values()
        return {str(frame[key]) for frame in frames for key in keys if key in frame}
    except (DataError, LookupError, TypeError):
        return set()


def publish(scene: Path, place: Path) -> None:
    """Move a finished scene to its place, where an earlier one is replaced.

    Raises:
        DataError: it cannot be written; what has not been moved is kept for the next try.
    """
    try:
        remove_leftovers(scene)
        place.parent.mkdir(parents=True, exist_ok=True)
        if not place.exists() and _rename(scene, place):
            return
        _bring(scene, place / WORK)
        finish(place)
    except OSError as error:
        raise DataError(
            f"{error.filename or place}: cannot be written: {error.strerror or error}; free space "
            "or choose another --out; what is finished is kept"
        ) from error


def _bring(scene: Path, work: Path) -> None:
    """Move a finished scene into the folder of work, or leave that as it was."""
    try:
        mark(work)
        if not _rename(scene, work / _NEW):
            shutil.copytree(scene, work / _PART)
            (work / _PART).rename(work / _NEW)
    except BaseException:
        with suppress(OSError):
            remove_marked(work)
        raise


def _rename(scene: Path, target: Path) -> bool:
    """Return whether a folder could be renamed; it cannot from one file system to another."""
    try:
        scene.rename(target)
    except OSError as error:
        if error.errno not in (errno.EXDEV, errno.EBUSY):
            raise
        return False
    return True


def finish(place: Path) -> None:
    """Go on with moving a new scene up that a killed process had begun with.

    Raises:
        OSError: something cannot be moved.
    """
    work = place / WORK
    if not is_marked(work):
        with suppress(OSError):
            work.rmdir()  # it was killed before the marker was there, or after it was gone
        return
    new, placing, old = work / _NEW, work / _PLACING, work / _OLD
    if new.is_dir():
        old.mkdir(exist_ok=True)
        for name in (*_FILES, *_FOLDERS):  # the description first: what lacks it is no scene
            if (place / name).exists():
                (place / name).rename(old / name)
        new.rename(placing)
    if placing.is_dir():
        for entry in sorted(placing.iterdir(), key=lambda path: path.name == SIGN):
            entry.rename(place / entry.name)
    remove_marked(work)


def restore(place: Path) -> None:
    """Put a scene back that a killed process of an earlier version had moved away."""
    earlier = place.with_name(f".{place.name}.earlier")
    if not place.exists() and is_scene(earlier):
        earlier.rename(place)
