"""Options whose names have changed: the old names are still read."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from gsdmsr_cli.options.strict import Located

MOTIONS = {"nodes": "control_points"}
"""Motions by the names that they had before version 0.2."""


def with_present_names(
    options: Mapping[str, Any], hint: Callable[[str], object] | None = None
) -> Located:
    """Return the options of a preset, or a part of them, under the names that they have now.

    Args:
        options: as they stand in a file, in ``--set`` or in ``run.json``.
        hint: called with one line for each name that has changed.

    Raises:
        TypeError: the options are no mapping.
    """
    if not isinstance(options, Mapping):
        raise TypeError(f"options are a {type(options).__name__}, not a mapping")
    located = _located(options)
    motion = _located(located.get("motion"))
    old = motion.get("name")
    if not isinstance(old, str) or old not in MOTIONS:
        return located
    if hint is not None:
        place = motion.places.get("name", "motion.name")
        hint(f"{place}: the motion '{old}' is called '{MOTIONS[old]}' now")
    renamed = Located({**motion, "name": MOTIONS[old]}, motion.places)
    return Located({**located, "motion": renamed}, located.places)


def _located(value: object) -> Located:
    """Return a mapping with the places it has, or an empty one for anything else."""
    if isinstance(value, Located):
        return value
    return Located(value if isinstance(value, Mapping) else None)
