"""Options of trainings of long sequences: moment after moment, or in segments of time."""

from __future__ import annotations

from dataclasses import dataclass

from gsdmsr_cli.options.durations import require_duration
from gsdmsr_cli.options.strict import require, require_at_least


@dataclass(frozen=True)
class StreamOptions:
    """Moments trained one after the other, each from the one before, see ``training.streaming``.

    The first takes ``training.steps`` or ``training.budget``. Progress goes from 0 to 1 in each.

    Attributes:
        enabled: whether that is done, in place of training all moments together.
        steps: length of every moment after the first [steps], unless there is a budget.
        budget: its length as wall time, such as "10s"; null counts steps.
        extrapolate: share of the last velocity with which a moment begins, 0 to 1.
        changed: mean difference from the picture of the moment before from which on a block of
            pixels counts as changed [range of colours]; tiles that have none are left out of most
            steps, and so are views that have few. 0 looks at all.
        ssim: weight of SSIM at moments after the first, in place of ``losses.ssim``: what is learnt
            there is where splats go, and absolute differences alone tell that better.
        rigidity: weight of how far neighbouring splats are from moving as a rigid body, from one
            moment to the next.
        rotation_similarity: weight of how differently neighbours turn from one to the next.
        isometry: weight of how far their distances are from those at the first moment.
        neighbours: how many of its nearest others, at the first moment, a splat is compared with.
        samples: splats that are compared with theirs in a step, chosen at random.
        keyframe_every: moments from one that is written whole to the next; those in between are
            written as differences from it.
        place_step: what positions are rounded to where they are written [scene bounds].
        turn_step: what quaternions of turns are rounded to there.
    """

    enabled: bool = False
    steps: int = 200
    budget: str | None = None
    extrapolate: float = 1.0
    changed: float = 0.0
    ssim: float = 0.0
    rigidity: float = 0.05
    rotation_similarity: float = 0.2
    isometry: float = 0.02
    neighbours: int = 8
    samples: int = 4096
    keyframe_every: int = 10
    place_step: float = 1e-4
    turn_step: float = 2e-3

    def __post_init__(self) -> None:
        require_at_least(self, 1, "steps", "keyframe_every", "neighbours", "samples")
        for key in ("rigidity", "rotation_similarity", "isometry"):
            require(self, key, getattr(self, key) >= 0, "0 or more")
        require_duration(self, "budget")
        require(self, "extrapolate", 0.0 <= self.extrapolate <= 1.0, "0 to 1")
        require(self, "changed", 0.0 <= self.changed < 1.0, "0 or more, below 1")
        require(self, "ssim", 0.0 <= self.ssim <= 1.0, "a weight from 0 to 1")
        for key in ("place_step", "turn_step"):
            require(self, key, 1e-7 <= getattr(self, key) <= 0.1, "1e-7 to 0.1")


@dataclass(frozen=True)
class SegmentOptions:
    """Segments of time that are trained each by itself and joined, see ``scene.segments``.

    Each takes ``training.steps`` or ``training.budget``.

    Attributes:
        count: how many segments of equal length there are; 1 leaves the time whole.
        overlap: what each shares with the next, as a share of its length, 0 to below 0.5.
        static_share: length of the training of what stands still, from the views of all times,
            whose splats all segments begin with, as a share of a segment's; 0: they begin anew.
    """

    count: int = 1
    overlap: float = 0.1
    static_share: float = 0.25

    def __post_init__(self) -> None:
        require_at_least(self, 1, "count")
        require(self, "overlap", 0.0 <= self.overlap < 0.5, "0 or more, below 0.5")
        require(self, "static_share", 0.0 <= self.static_share <= 1.0, "a share from 0 to 1")

    @property
    def several(self) -> bool:
        """Whether the time is cut at all."""
        return self.count > 1
