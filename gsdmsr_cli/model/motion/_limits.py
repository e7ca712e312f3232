"""Checks of options that motions alone have; those of other layers too are ``model.limits``."""

from __future__ import annotations

from gsdmsr_cli.backends.cuda.compiler import MOST_LEVELS
from gsdmsr_cli.ops.planes import DEGREES
from gsdmsr_cli.options.strict import require


def require_resolutions(options: object, *keys: str) -> None:
    """Check that resolutions of grids along an axis are 2 or more.

    Raises:
        InvalidError: one is not.
    """
    for key in keys:
        require(options, key, getattr(options, key) >= 2, "2 or more")


def require_degree(options: object, key: str) -> None:
    """Check the degree of the B-splines between a plane grid's nodes in time.

    Raises:
        InvalidError: grids have none of that degree.
    """
    within = getattr(options, key) in DEGREES
    require(options, key, within, " or ".join(map(str, DEGREES)))


def require_levels(options: object, key: str, besides: int = 0) -> None:
    """Check the resolution of each level of a grid that is read with ``besides`` other levels.

    Raises:
        InvalidError: there are none, too many, or one has a resolution below 2.
    """
    levels, most = getattr(options, key), MOST_LEVELS - besides
    ok = 1 <= len(levels) <= most and min(levels) >= 2
    require(options, key, ok, f"1 to {most} whole numbers, each 2 or more")
