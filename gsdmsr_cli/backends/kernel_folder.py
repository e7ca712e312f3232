"""Chooses the folder that compiled kernels are kept in: a temporary one where no other serves."""

from __future__ import annotations

import atexit
import os
import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path

from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import can_be_written


def choose_folder(candidates: Sequence[Path]) -> Path:
    """Return the first folder that can be written, or made; else one that ends with the process.

    Raises:
        DataError: there is no place for temporary files either.
    """
    found = next(filter(can_be_written, candidates), None)
    return found or _temporary(" nor in ".join(map(str, candidates)))


def _temporary(elsewhere: str) -> Path:
    remedy = "set NUMBA_CACHE_DIR to a folder that can be written"
    try:
        folder = Path(tempfile.mkdtemp(prefix="gsdmsr-kernels-"))
    except OSError as error:
        raise DataError(
            f"compiled kernels can be kept neither in {elsewhere} nor in a temporary folder: "
            f"{error.strerror or error}; {remedy}"
        ) from error
    atexit.register(_remove, folder, os.getpid())
    say.warn(
        f"compiled kernels cannot be kept in {elsewhere}, so every command compiles them anew, "
        f"which takes about a minute; {remedy}"
    )
    return folder


def _remove(folder: Path, owner: int) -> None:
    if os.getpid() == owner:  # and not a fork, whose end is not that of the command
        shutil.rmtree(folder, ignore_errors=True)
