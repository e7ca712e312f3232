"""Chooses which of many pictures become frames: sharp ones that show something, evenly in time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

BLURRED = 0.2
"""Frames are left out whose sharpness is below this share of their neighbours' median."""

NEIGHBOURS = 5
"""So many frames before and after one are its neighbours."""

PLAIN = 0.5
"""Sharpness below which a picture is of one colour, as black ones are after any codec."""


@dataclass(frozen=True)
class Candidate:
    """A picture that might become a frame.

    Attributes:
        file: name of the picture or video.
        index: number of the frame in its video.
        time: seconds, or steps where seconds are unknown, from the first.
        sharpness: variance of the Laplacian, or 0 where it is not known.
    """

    file: str
    index: int
    time: float
    sharpness: float = 0.0


def leave_out_plain(candidates: Sequence[Candidate]) -> list[Candidate]:
    """Return those that are not of one colour, such as the black ones of a fade."""
    return [candidate for candidate in candidates if candidate.sharpness >= PLAIN]


def choose(candidates: Sequence[Candidate], count: int) -> list[Candidate]:
    """Return the sharpest candidate of each of ``count`` equal parts of the time; all if fewer."""
    if len(candidates) <= count:
        return list(candidates)
    first, last = candidates[0].time, candidates[-1].time
    bins: dict[int, Candidate] = {}
    for candidate in candidates:
        part = min(int((candidate.time - first) / (last - first) * count), count - 1)
        if part not in bins or candidate.sharpness > bins[part].sharpness:
            bins[part] = candidate
    return list(bins.values())


def leave_out_blurred(chosen: Sequence[Candidate]) -> tuple[list[Candidate], list[Candidate]]:
    """Return the frames that are as sharp as their neighbours, and those that are not nearly so.

    Sharpness depends on what is seen, so only frames close in time are compared.
    """
    taken: list[Candidate] = []
    blurred: list[Candidate] = []
    for i, frame in enumerate(chosen):
        near = [other.sharpness for other in chosen[max(i - NEIGHBOURS, 0) : i + NEIGHBOURS + 1]]
        poor = frame.sharpness < BLURRED * float(np.median(near))
        (blurred if poor else taken).append(frame)
    return taken, blurred
