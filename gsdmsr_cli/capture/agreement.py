"""Whether the clocks of a rig's cameras agree, as far as that shows in when things move.

How much a picture differs from the one before rises and falls with what happens in the scene, in
all cameras at the same time. A camera whose clock is ahead fits the others best when it is shifted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

LONGEST = 3.0
"""Shifts are tried up to this, or up to a quarter of the time in which all film [s]."""

SURE, BETTER = 4.5, 2.0
"""Correlation with the other cameras that a shift must reach, and by how much more than without: in
units of what chance gives to curves that have nothing to do with each other."""

SHIFTED = 1.5
"""A clock that is off by less than so many frames is taken for right: frames are no finer."""


@dataclass(frozen=True)
class Film:
    """What is known of a camera's video.

    Attributes:
        file: its name.
        times: (N,) of its frames, on the clock of the rig [s].
        changes: (N - 1,) how much each frame differs from the one before it.
    """

    file: str
    times: Floats
    changes: Floats


def clock_doubts(films: Sequence[Film]) -> list[str]:
    """Return a sentence on every camera whose clock seems to be off, or to run at another speed."""
    first = max(float(film.times[0]) for film in films)
    last = min(float(film.times[-1]) for film in films)
    step = max(float(np.median(np.diff(film.times))) for film in films)
    grid = np.arange(first, last, step)
    if len(grid) < 2:
        return []
    curves = [_curve(film, grid) for film in films]
    found = []
    for i, film in enumerate(films):
        others = np.median([*curves[:i], *curves[i + 1 :]], axis=0)
        halves = np.array_split(np.arange(len(grid)), 2)
        begins, ends = (_lag(curves[i][half], others[half], step) for half in halves)
        whole = _lag(curves[i], others, step)
        if begins is not None and ends is not None and abs(ends - begins) > 2 * SHIFTED * step:
            found.append(
                f"the clock of {film.file} seems to drift: against the other cameras it is "
                f"{begins:+.2f} s ahead in the first half and {ends:+.2f} s in the second, "
                "which no --offset mends; cut the videos into shorter parts"
            )
        elif whole is not None and abs(whole) > SHIFTED * step:
            found.append(
                f"the clock of {film.file} seems to be {whole:+.2f} s ahead of those of the other "
                f"cameras: try --offset {film.file.rpartition('.')[0]}={whole:.2f} in addition to "
                "what was given"
            )
    return found


def _curve(film: Film, grid: Floats) -> Floats:
    """Return how much changes before a camera at the times of a grid, ranked from -1 to 1.

    Ranks, since one thing may look large to one camera and small to another.
    """
    middles = (film.times[1:] + film.times[:-1]) / 2
    speeds = film.changes / np.diff(film.times)
    values = np.interp(grid, middles, speeds)
    ranks = np.searchsorted(np.sort(values), values, side="left").astype(np.float64)
    return 2 * ranks / max(len(grid) - 1, 1) - 1


def _lag(own: Floats, others: Floats, step: float) -> float | None:
    """Return by how much a curve is ahead of the others' [s]; None if that cannot be told.

    0 where no shift fits better than none. What is ahead shows later, by its own clock.
    """
    reach = min(round(LONGEST / step), len(own) // 4)
    lags = np.arange(-reach, reach + 1)
    fits = np.array([_fit(own, others, int(lag)) for lag in lags])
    best, chance = int(fits.argmax()), _by_chance(own, others)
    if fits[best] < SURE * chance:
        return None
    if best in (0, len(lags) - 1) or fits[best] < fits[reach] + BETTER * chance:
        return 0.0 if fits[reach] >= SURE * chance else None
    return float(lags[best]) * step


def _by_chance(own: Floats, others: Floats) -> float:
    """Return the standard deviation of the correlation of two curves that are independent.

    By Bartlett (1935): curves that change slowly are alike by chance more easily.
    """
    one, other = (_autocorrelation(curve) for curve in (own, others))
    return float(np.sqrt(max(1 + 2 * (one * other).sum(), 1) / len(own)))


def _autocorrelation(curve: Floats) -> Floats:
    """Return the correlations of a curve with itself, shifted by one step up to a quarter of it."""
    return np.array([_fit(curve, curve, lag) for lag in range(1, len(curve) // 4 + 1)])


def _fit(own: Floats, others: Floats, lag: int) -> float:
    """Return the correlation of a curve with the others', which it is behind by ``lag`` steps."""
    count = len(own) - abs(lag)
    mine, theirs = own[max(lag, 0) :][:count], others[max(-lag, 0) :][:count]
    if mine.std() < 1e-9 or theirs.std() < 1e-9:
        return 0.0
    return float(np.corrcoef(mine, theirs)[0, 1])
