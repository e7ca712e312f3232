"""When frames were really taken: an offset of the time of each, learnt with the motion.

Pictures say at which time they were taken, and what moves in them need not be where it was then: an
animation whose keys lie on whole frames of another rate, a recorder that drops a frame and shows
one twice. To a motion that is smooth in time this looks like a start and a stop at every frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from gsdmsr_cli.model.motion._grids import between
from gsdmsr_cli.model.parameter import Parameter

_AROUND = -0.25, 0.25
"""The two times of which a motion's slope is taken, after that of the slope [frames]."""


class TimeOffsets:
    """Offsets of the times of frames, straight lines between them.

    Attributes:
        values: (F,) by how much later than it says a picture was taken [frames].
    """

    def __init__(self, frames: int) -> None:
        """Begin without offsets.

        Args:
            frames: number F of distinct train times, 2 or more.
        """
        self.values = torch.zeros(frames)
        self._frame = 1 / (frames - 1)

    def parameters(self, name: str) -> Sequence[Parameter]:
        """Return the offsets as what is trained, under a name."""
        return (Parameter(name, self.values, rate="embeddings", time_axis=0),)

    def inside(self, time: float) -> float:
        """Return where in [0, 1] a time lies that may be a frame before 0 or after 1.

        So a first frame may have been taken before its time, and a last one after.
        """
        return min(max((time + self._frame) / (1 + 2 * self._frame), 0.0), 1.0)

    def follow(self, motion: Callable[[Sequence[float]], Tensor], times: Sequence[float]) -> Tensor:
        """Return what a motion is at the times T that frames were taken at, (T, ...).

        The gradient of an offset is that of its time by the motion's central difference.

        Args:
            motion: returns (T, ...) at any times.
            times: what the frames say, in [0, 1].
        """
        offsets = torch.stack([between(self.values, time) for time in times])
        taken = self._later(times, offsets.tolist())
        values = motion(taken)
        if not torch.is_grad_enabled():
            return values
        with torch.no_grad():
            around = [self._later(taken, [by] * len(taken)) for by in _AROUND]
            before, after = motion([*around[0], *around[1]]).chunk(2)
            slopes = (after - before) / (_AROUND[1] - _AROUND[0])
        zeros = offsets - offsets.detach()
        return values + zeros.view(-1, *[1] * (values.dim() - 1)) * slopes

    def _later(self, times: Sequence[float], offsets: Sequence[float]) -> list[float]:
        """Return the times plus offsets in frames."""
        return [time + by * self._frame for time, by in zip(times, offsets, strict=True)]

    def check(self, frames: int) -> None:
        """Raise ValueError unless there is one for each frame."""
        if tuple(self.values.shape) != (frames,):
            raise ValueError(f"time offsets {tuple(self.values.shape)} for {frames} frames")
