"""Which of the rows that a layer holds for views belong to a view, also to one not trained on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.nearness import MOST_TURN, centres_of, extent, ways_and_turns

Per = Literal["auto", "frame", "camera"]
"""What has a row: each picture, or each fixed camera with all its pictures; "auto" is "camera" for
rigs, at least two fixed cameras with at least two pictures each in the mean."""

Weights = tuple[tuple[int, float], ...]
"""Rows and their weights, which add up to 1; nothing where no row has to do with a view."""

SAME = 1e-6
"""Most difference in time, angle [rad] and way [scene bounds] of a view from itself."""

LEAST_REACH = 0.02
"""Cameras this near are neighbours in any case [scene bounds]: a hand trembles."""

MOST_STEP = 0.6
"""A camera that usually goes farther from one moment to the next, in units of how far any is from
their mean, jumps: there is no path."""

STEPS = 3
"""Neighbours one moment apart are at most so many usual steps of the path apart."""

WIDER = 2
"""Neighbours are looked for among so many times as many moments as are wanted: where two cameras
take turns, every second one is of the same."""


ALWAYS = -1.0
"""In place of the time of a row that is a fixed camera's at all times."""


@dataclass(frozen=True, eq=False)
class ViewRows:
    """The train views of a capture, or its fixed cameras, and the row of each.

    Attributes:
        times: (V,) float64 in [0, 1]; ``ALWAYS`` of fixed cameras, which earlier versions had once
            for each of their views.
        poses: (V, 4, 4) float64, world to camera.
        rows: (V,) int64, which row belongs to each.
        bound: of the scene [world units].
        beside: how many neighbours before, and after, a view that was not trained on count.
    """

    times: NDArray[np.float64]
    poses: NDArray[np.float64]
    rows: NDArray[np.int64]
    bound: float
    beside: int = 1
    _known: dict[tuple[float, bytes], Weights] = field(default_factory=dict)

    @property
    def count(self) -> int:
        """How many rows there are."""
        return int(self.rows.max()) + 1 if len(self.rows) else 0

    @property
    def per_camera(self) -> bool:
        """Whether rows are those of fixed cameras."""
        return bool((self.times == ALWAYS).any()) or self.count < len(self.rows)

    def centres(self) -> NDArray[np.float64]:
        """Return where the camera of each row stands, (rows, 3); of several the first."""
        _, firsts = np.unique(self.rows, return_index=True)
        return centres_of(self.poses[firsts])

    def weights(self, camera: Camera, time: float) -> Weights:
        """Return which rows belong to a view, from where and when it was taken.

        A train view has its own row. Any other one has, where rows are those of fixed cameras, that
        of its camera. Else it has the line in time that fits best, by least squares, to its nearest
        neighbours before and after on the path of one camera: with one on each side, linear
        interpolation. Where there are some on one side alone, it has their mean.
        """
        key = time, camera.world_to_camera.tobytes()
        if key not in self._known:
            self._known[key] = self._found(camera, time)
        return self._known[key]

    def own(self, camera: Camera, time: float) -> int | None:
        """Return the row that was held for a view itself, or for its camera; None if none was."""
        ways, turns = ways_and_turns(camera.world_to_camera, self.poses)
        here = (ways <= SAME * self.bound) & (turns <= SAME)
        if not self.per_camera:
            here &= np.abs(self.times - time) <= SAME
        return int(self.rows[here.argmax()]) if here.any() else None

    def _found(self, camera: Camera, time: float) -> Weights:
        own = self.own(camera, time)
        if own is not None:
            return ((own, 1.0),)
        if self.per_camera or not len(self.rows):
            return ()
        both = [self._beside(camera, time, after) for after in (False, True)]
        chosen = np.concatenate(both)
        shares = np.full(len(chosen), 1 / max(len(chosen), 1))
        if all(map(len, both)):
            since = self.times[chosen] - time
            shares = np.linalg.pinv(np.stack([np.ones_like(since), since], axis=1))[0]
        return tuple(zip(self.rows[chosen].tolist(), shares.tolist(), strict=True))

    def _beside(self, camera: Camera, time: float, after: bool) -> NDArray[np.int64]:
        """Return the neighbours on one side in time, those that were taken from nearest by.

        The farther in time the farther they may be; but none count if the first are not near.
        """
        if not self.reach:
            return np.empty(0, np.int64)
        ways, turns = ways_and_turns(camera.world_to_camera, self.poses)
        moments = self.moments if after else self.moments[::-1]
        moments = moments[moments > time] if after else moments[moments <= time]
        order = {moment: i + 1 for i, moment in enumerate(moments[: WIDER * self.beside].tolist())}
        apart = np.array([order.get(one, 0) for one in self.times.tolist()])
        near = (apart > 0) & (ways <= apart * self.reach) & (turns <= apart * MOST_TURN)
        if not (near & (apart <= WIDER)).any():
            return np.empty(0, np.int64)
        (chosen,) = near.nonzero()
        return chosen[np.argsort(ways[chosen], kind="stable")[: self.beside]]

    @cached_property
    def moments(self) -> NDArray[np.float64]:
        """Distinct times, ascending."""
        return np.unique(self.times)

    @cached_property
    def reach(self) -> float:
        """How far neighbours may be one moment apart [world units]; 0 where cameras jump."""
        steps = np.array([self._step(view) for view in range(len(self.times))])
        way, turn = np.median(steps, axis=0)
        floor = LEAST_REACH * self.bound
        if turn > MOST_TURN or way > max(MOST_STEP * extent(centres_of(self.poses)), floor):
            return 0.0
        return max(STEPS * float(way), floor)

    def _step(self, view: int) -> tuple[float, float]:
        """Return way and turn from a view to that of the moments around it which is nearest."""
        place = int(np.searchsorted(self.moments, self.times[view]))
        around = self.moments[max(place - WIDER, 0) : place + WIDER + 1]
        others = np.isin(self.times, around) & (self.times != self.times[view])
        if not others.any():
            return np.inf, np.inf
        ways, turns = ways_and_turns(self.poses[view], self.poses[others])
        nearest = ways.argmin()
        return float(ways[nearest]), float(turns[nearest])


def rows_of(views: Sequence[tuple[Camera, float]], per: Per, bound: float, beside: int) -> ViewRows:
    """Return the rows of train views, given as camera and time."""
    times = np.array([time for _, time in views], np.float64)
    poses = np.stack([camera.world_to_camera for camera, _ in views])
    cameras = _grouped(poses, bound)
    fixed = int(cameras.max()) + 1
    rig = fixed >= 2 and 2 * fixed <= len(views)
    if per == "camera" or (per == "auto" and rig):
        _, firsts = np.unique(cameras, return_index=True)
        always = np.full(fixed, ALWAYS)
        return ViewRows(always, poses[firsts], np.arange(fixed), bound, beside)
    return ViewRows(times, poses, np.arange(len(views)), bound, beside)


def _grouped(poses: NDArray[np.float64], bound: float) -> NDArray[np.int64]:
    """Return which camera each of the poses belongs to, numbered as they come (V,)."""
    groups = np.full(len(poses), -1, np.int64)
    count = 0
    for view in range(len(poses)):
        if groups[view] < 0:
            ways, turns = ways_and_turns(poses[view], poses)
            groups[(ways <= SAME * bound) & (turns <= SAME) & (groups < 0)] = count
            count += 1
    return groups
