"""The clocks of a rig's cameras: which frames are of which moment, and what is doubtful."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.ground.errors import DataError

Floats = NDArray[np.float64]

NEAR = 0.75
"""A frame is of a moment if it is at most this far from it, in units of the usual time between two
frames of the camera. Half of that is what cameras that have lost none need; the rest is for phones,
whose frames do not come evenly."""

LONGER = 1.25
"""So many times as long as all cameras the others must film without one to have it named."""


def common_moments(clocks: Sequence[Floats], most: int, root: Path) -> Floats:
    """Return up to ``most`` moments, evenly over the time in which all cameras film.

    As many as the slowest camera has frames there, if those are fewer.

    Args:
        clocks: times of every camera's frames [s].
        most: moments, at most.
        root: of the cameras' videos, for messages.

    Raises:
        DataError: there is no such time.
    """
    first, last = _shared(clocks)
    inside = [int(((clock >= first) & (clock <= last)).sum()) for clock in clocks]
    if last <= first or min(inside) < 2:
        raise DataError(f"{root}: the cameras do not film at the same time; check --offset")
    return np.linspace(first, last, min(most, *inside))


def _shared(clocks: Sequence[Floats]) -> tuple[float, float]:
    """Return the beginning and the end of the time in which all film [s]."""
    return max(float(clock[0]) for clock in clocks), min(float(clock[-1]) for clock in clocks)


def frames_at(clock: Floats, moments: Floats) -> NDArray[np.int64]:
    """Return the frame of a camera at each moment, -1 where it has none near enough.

    Args:
        clock: times of the camera's frames, two or more, ascending [s].
        moments: (M,) times [s].
    """
    apart = np.abs(clock[None] - moments[:, None])
    nearest = apart.argmin(axis=1)
    near = apart[np.arange(len(moments)), nearest] <= NEAR * float(np.median(np.diff(clock)))
    return np.where(near, nearest, -1)


def doubts_about(files: Sequence[str], clocks: Sequence[Floats], moments: Floats) -> list[str]:
    """Return sentences on cameras that have lost frames, or that film much shorter than others.

    Args:
        files: names of the videos.
        clocks: times of their frames [s].
        moments: of ``common_moments``.
    """
    found = []
    for file, clock in zip(files, clocks, strict=True):
        missing = int((frames_at(clock, moments) < 0).sum())
        if missing:
            found.append(
                f"{file} has no frame at {missing} of {len(moments)} moments: it has lost some; "
                "there it is left out"
            )
    first, last = _shared(clocks)
    for i, (file, clock) in enumerate(zip(files, clocks, strict=True)):
        begins, ends = _shared([*clocks[:i], *clocks[i + 1 :]])
        if ends - begins > LONGER * (last - first):
            found.append(
                f"only {last - first:.1f} s are taken, in which all cameras film: without {file}, "
                f"which films for {clock[-1] - clock[0]:.1f} s, it would be {ends - begins:.1f} s; "
                "move it away to use them"
            )
    return found
