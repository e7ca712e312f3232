"""Checks that options of layers ask for sizes of grids and networks that the kernels support.

The limits are those of all devices, so that what has been trained on one goes on on another.
"""

from __future__ import annotations

from gsdmsr_cli.backends.cpu.simd import LANES
from gsdmsr_cli.backends.cuda.compiler import MOST_HASH_LEVELS
from gsdmsr_cli.options.strict import require


def require_multiples(options: object, *keys: str, least: int = LANES) -> None:
    """Check that options are multiples of 16, ``least`` or more, in a ``__post_init__``.

    Raises:
        InvalidError: one is not.
    """
    for key in keys:
        value = getattr(options, key)
        ok = value >= least and value % LANES == 0
        require(options, key, ok, f"a multiple of {LANES}, {least} or more")


def require_hash_levels(options: object, levels: str, features: str) -> None:
    """Check how many levels a hash grid has, and how many features these give together.

    Raises:
        InvalidError: there are too few or too many levels, or they do not fit a network.
    """
    count, each = getattr(options, levels), getattr(options, features)
    require(options, levels, 1 <= count <= MOST_HASH_LEVELS, f"1 to {MOST_HASH_LEVELS}")
    require(options, features, 1 <= each <= 8, "1 to 8")
    whole = count * each % LANES == 0
    require(options, levels, whole, f"times {features} a multiple of {LANES}")


def require_hash_sizes(options: object, *resolutions: str) -> None:
    """Check pairs of resolutions of a hash grid's levels, and ``log2_rows``.

    Raises:
        InvalidError: a pair falls or is below 2, or tables have too few or too many rows.
    """
    for key in resolutions:
        low, high = getattr(options, key)
        require(options, key, 2 <= low <= high, "[first, last], the first 2 or more")
    rows = vars(options)["log2_rows"]
    require(options, "log2_rows", 4 <= rows <= 24, "4 to 24")
