"""Segments of a capture's time, which overlap: which times belong to which, and by how much."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.scene import Scene

_ROUNDING = 1e-9
"""Times this near to an end of a segment lie in it."""


@dataclass(frozen=True)
class Segment:
    """A stretch of a capture's time.

    Attributes:
        start, end: times in [0, 1], the first before the second.
    """

    start: float
    end: float

    def holds(self, time: float) -> bool:
        """Return whether a time of the capture lies in the segment, its ends included."""
        return self.start - _ROUNDING <= time <= self.end + _ROUNDING

    def within(self, time: float) -> float:
        """Return a time of the capture as one of the segment, 0 to 1; outside, that of its end."""
        return min(max((time - self.start) / (self.end - self.start), 0.0), 1.0)


def cut(count: int, overlap: float) -> list[Segment]:
    """Return so many segments of equal length that cover all times.

    Args:
        count: 1 or more.
        overlap: what each shares with the next, as a share of its length, 0 to below 0.5; so no
            time lies in more than two.
    """
    length = 1 / (count - (count - 1) * overlap)
    starts = [i * length * (1 - overlap) for i in range(count)]
    ends = [start + length for start in starts[:-1]]
    return [Segment(start, end) for start, end in zip(starts, [*ends, 1.0], strict=True)]


def weights(time: float, segments: Sequence[Segment]) -> dict[int, float]:
    """Return by how much each segment counts at a time, those that do not left out; the sum is 1.

    Where two overlap the weight goes over from one to the other at a constant rate.

    Args:
        time: in [0, 1]; times before the first count as its start, times after the last as its end.
        segments: that cover a stretch of time, in its order, at most two at any time.
    """
    time = min(max(time, segments[0].start), segments[-1].end)
    last = max(i for i, segment in enumerate(segments) if i == 0 or segment.start <= time)
    if last == 0 or (shared := segments[last - 1].end - segments[last].start) <= 0:
        return {last: 1.0}
    gone = min((time - segments[last].start) / shared, 1.0)
    found = {last - 1: 1.0 - gone, last: gone}
    return {i: weight for i, weight in found.items() if weight > 0}


def between(scene: Scene, start: float, end: float) -> Scene:
    """Return the views from a time to another, which count from 0 at the first to 1 at the last.

    Raises:
        DataError: no train view lies there.
    """
    segment = Segment(start, end)
    if segment == Segment(0.0, 1.0):
        return scene
    views = tuple(
        replace(view, time=segment.within(view.time))
        for view in scene.views
        if segment.holds(view.time)
    )
    if not any(view.split == "train" for view in views):
        raise DataError(
            f"{scene.root}: no train view lies between {segment.start:g} and {segment.end:g} of "
            "its time; choose another data.between"
        )
    lasts = None if scene.duration is None else scene.duration * (segment.end - segment.start)
    return replace(scene, views=views, duration=lasts)
