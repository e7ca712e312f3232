"""Finds plug-ins: every module of a folder is one, named by its file."""

from __future__ import annotations

import importlib
import pkgutil
from types import ModuleType

from gsdmsr_cli.ground.errors import UsageError, nearest


def names(package: str) -> list[str]:
    """Return the sorted names of the plug-ins in ``package``; modules with a leading _ are none."""
    paths = importlib.import_module(package).__path__
    return sorted(m.name for m in pkgutil.iter_modules(paths) if not m.name.startswith("_"))


def load(package: str, name: str) -> ModuleType:
    """Import the plug-in ``name`` of ``package``.

    A package may say with ``KIND`` what its plug-ins are called, if not as itself.

    Raises:
        UsageError: there is no such plug-in.
    """
    known = names(package)
    if name not in known:
        default = package.rpartition(".")[2]
        kind = getattr(importlib.import_module(package), "KIND", default)
        raise UsageError(f"unknown {kind} '{name}'; {nearest(name, known)}")
    return importlib.import_module(f"{package}.{name}")
