"""Refuses masks that leave everything out: a training would learn nothing, without a word."""

from __future__ import annotations

from collections.abc import Sequence

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import MASK, View

LOOKED_AT = 24
"""Views whose masks are read, evenly spaced."""


def check_masks(pictures: Pictures, views: Sequence[View]) -> str | None:
    """Return a warning if some views' masks count no pixel, None if all count some.

    Args:
        pictures: of the views.
        views: one or more, of which some are looked at.

    Raises:
        DataError: nothing counts in any of those that were looked at, or a mask cannot be read.
    """
    chosen = views[:: -(-len(views) // LOOKED_AT)]
    empty = [view for view in chosen if _is_empty(pictures, view)]
    if not empty:
        return None
    told = f"masks leave out every pixel of {len(empty)} of {len(chosen)} train views looked at"
    which = f"such as {empty[0].signals[MASK]}; white counts, black does not"
    if len(empty) == len(chosen):
        raise DataError(f"{told}, {which}: invert them, or leave them out")
    return f"{told}, {which}: nothing is learnt from these"


def _is_empty(pictures: Pictures, view: View) -> bool:
    mask = pictures.signal(view, MASK)
    return mask is not None and not bool(mask.any())
