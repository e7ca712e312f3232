"""When frames were really taken: an offset of the time of each, learnt with the motion.

Pictures say at which time they were taken, and what moves in them need not be where it was then: an
animation whose keys lie on whole frames of another rate, a recorder that drops a frame and shows
one twice. To a motion that is smooth in time this looks like a start and a stop at every frame.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.ops.hats import hats

_AROUND = -0.25, 0.25
"""The two times of which a motion's slope is taken, after that of the slope [frames]."""

_READ_EVERY = 1e-3
"""Progress after which a training reads its offsets anew, for which a GPU is waited for."""

Clock = Callable[[float], float]
"""Says at which time a frame of a time was taken."""


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
        self._frames, self._known = np.arange(frames), np.zeros(frames)
        self._known_at = -1.0

    def parameters(self, name: str) -> Sequence[Parameter]:
        """Return the offsets as what is trained, under a name."""
        return (Parameter(name, self.values, rate="embeddings", time_axis=0),)

    def advance(self, progress: float) -> None:
        """Read the offsets if those that are known are of too long ago."""
        if abs(progress - self._known_at) >= _READ_EVERY:
            self._read()
            self._known_at = progress

    def _read(self) -> None:
        self._known = np.array(self.values.tolist())

    def of(self, times: Sequence[float]) -> list[float]:
        """Return the offsets of frames of these times [frames]."""
        found: list[float] = (hats(times, self.values) @ self.values).tolist()
        return found

    def inside(self, time: float) -> float:
        """Return where in [0, 1] a time lies that may be a frame before 0 or after 1.

        So a first frame may have been taken before its time, and a last one after.
        """
        return min(max((time + self._frame) / (1 + 2 * self._frame), 0.0), 1.0)

    def follow(self, motion: Callable[[Clock], Tensor], times: Sequence[float]) -> Tensor:
        """Return what a motion is when the frames of T times were taken, (T, ...).

        The gradient of an offset is that of its time by the motion's central difference.

        Args:
            motion: returns (T, ...) at the times to which a clock takes ``times``.
            times: what the frames say, in [0, 1].
        """
        if self.values.device.type == "cpu" or not torch.is_grad_enabled():
            self._read()  # a step on a GPU waits for nothing
        values = motion(self._clock(0.0))
        if not torch.is_grad_enabled():
            return values
        with torch.no_grad():
            before, after = (motion(self._clock(by)) for by in _AROUND)
            slopes = (after - before) / (_AROUND[1] - _AROUND[0])
        offsets = hats(times, self.values) @ self.values
        zeros = offsets - offsets.detach()
        return values + zeros.view(-1, *[1] * (values.dim() - 1)) * slopes

    def _clock(self, later: float) -> Clock:
        """Return the clock of the offsets, and by how many frames it is later than that."""

        def taken(time: float) -> float:
            offset = float(np.interp(time / self._frame, self._frames, self._known))
            return time + (offset + later) * self._frame

        return taken

    def check(self, frames: int) -> None:
        """Raise ValueError unless there is one for each frame."""
        if tuple(self.values.shape) != (frames,):
            raise ValueError(f"time offsets {tuple(self.values.shape)} for {frames} frames")
