"""Which state of the source this is: the version, and the commit built or run from."""

from __future__ import annotations

import subprocess
from functools import cache
from importlib import resources
from pathlib import Path

from gsdmsr_cli import __version__

_PACKAGE = Path(__file__).parents[1]

BUILT_FROM = "built_from.txt"
"""Beside ``__init__.py`` in what pip has built: the commit, as `git describe` names it."""


@cache
def commit() -> str | None:
    """Return the commit, such as "1a2b3c4d5e" or "1a2b3c4d5e-dirty", or None where nobody knows.

    A clone that is run as it stands is asked with git; a package that was built from one has it in
    a file.
    """
    try:
        return (resources.files("gsdmsr_cli") / BUILT_FROM).read_text(encoding="ascii").strip()
    except OSError:
        return describe(_PACKAGE.parent)


def describe(clone: Path) -> str | None:
    """Return the commit of a clone, with "-dirty" if tracked files differ from it."""
    if not (clone / ".git").exists():
        return None  # a clone around site-packages is another project's
    line = [
        "git",
        "-C",
        str(clone),
        "describe",
        "--always",
        "--dirty",
        "--abbrev=10",
        "--exclude=*",
    ]
    try:
        found = subprocess.run(line, capture_output=True, text=True, timeout=5, check=False)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return found.stdout.strip() or None


def version() -> str:
    """Return the version with where it comes from: "0.2.0 (commit 1a2b3c4d5e, PLACE)"."""
    return f"{__version__} (commit {commit() or 'unknown'}, {_PACKAGE})"
