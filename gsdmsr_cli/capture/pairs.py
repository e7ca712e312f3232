"""Chooses which pairs of frames COLMAP compares."""

from __future__ import annotations

from itertools import combinations

NEIGHBOURS = 10
"""Each frame is compared with so many after it, and with some farther away."""

FARTHEST = 128

KEYFRAMES = 20
"""Of so many frames, evenly chosen, each is compared with each, to find loops."""

FEW = 40
"""Pictures in a folder, up to this number, are all compared with one another."""


def choose_pairs(count: int, matching: str, video: bool) -> list[tuple[int, int]]:
    """Return pairs i < j of frames 0 to ``count`` - 1, ascending.

    Args:
        count: number of frames, in the order of time.
        matching: "sequential", "exhaustive", "both" or "auto", which is exhaustive for few
            pictures that are no video and else sequential.
        video: whether the frames are a video's.
    """
    if matching == "auto":
        matching = "exhaustive" if not video and count <= FEW else "sequential"
    everything = range(count)
    if matching == "exhaustive":
        return list(combinations(everything, 2))
    pairs = set(_sequential(count))
    if matching == "both":
        step = max(1, (count - 1) / (KEYFRAMES - 1))
        keys = sorted({min(round(i * step), count - 1) for i in range(KEYFRAMES)})
        pairs |= set(combinations(keys, 2))
    return sorted(pairs)


def _sequential(count: int) -> list[tuple[int, int]]:
    distances = list(range(1, NEIGHBOURS + 1))
    distance = 2 * NEIGHBOURS
    while distance <= FARTHEST:
        distances.append(distance)
        distance *= 2
    return [(i, i + d) for i in range(count) for d in distances if i + d < count]
