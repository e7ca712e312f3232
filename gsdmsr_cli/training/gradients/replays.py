"""Replays the work on a step's views on a GPU, while nothing but the views differs.

A GPU waits for Python for most of a step: some hundred launches, each handed over by itself. As a
recording they are handed over by one call.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

import torch
from torch import Tensor

from gsdmsr_cli.backends.cuda import graphs
from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.scene.camera import Camera

T = TypeVar("T")

PATIENCE = 3
"""Work that could not be recorded so often is done directly from then on."""


class ViewInputs(NamedTuple):
    """What differs from step to step, in the order of the views.

    Attributes:
        cameras: that they are drawn by, of one picture size.
        times: of each view, in [0, 1].
        targets: (3, H, W) uint8.
    """

    cameras: Sequence[Camera]
    times: Sequence[float]
    targets: Sequence[Tensor]


class Recording(Protocol):
    """Work that can be replayed."""

    def is_good(self) -> bool:
        """Return whether it may be replayed once more."""

    def replay(self, inputs: ViewInputs) -> Any:
        """Do the work with other inputs; what it returns is good until the next replay."""


class Recorder(Protocol):
    """Who records work."""

    def record(self, work: Callable[[], Any], inputs: ViewInputs) -> Recording:
        """Record work without doing it; a recording of before must not be replayed any more."""


class Replays:
    """Does work directly at first, and replays it from the second time on that it is the same.

    Args:
        recorder: who records it; None where all work is done directly.
    """

    def __init__(self, recorder: Recorder | None) -> None:
        self._recorder = recorder
        self._known: Hashable = None
        self._recording: Recording | None = None
        self._failures = 0

    @property
    def able(self) -> bool:
        """Whether work is ever recorded."""
        return self._recorder is not None

    def run(self, known: Hashable, inputs: ViewInputs, work: Callable[[], T]) -> T:
        """Return what ``work`` returns, which is good until the next run.

        Args:
            known: all that the work depends on beside the inputs and the values in memory that it
                reads, and where that memory is.
            inputs: of this run.
            work: to be done.
        """
        if self._recorder is None:
            return work()
        if known != self._known:
            self._known, self._recording = known, None
            return work()
        if self._recording is None or not self._recording.is_good():
            self._recording = None  # its memory serves the next one
            self._recording = self._record(self._recorder, inputs, work)
        if self._recording is None:
            return work()
        replayed: T = self._recording.replay(inputs)
        return replayed

    def _record(
        self, recorder: Recorder, inputs: ViewInputs, work: Callable[[], object]
    ) -> Recording | None:
        try:
            return recorder.record(work, inputs)
        except (RuntimeError, GsdmsrError) as error:
            self._failures += 1
            if self._failures == PATIENCE:
                self._recorder = None
                warnings.warn(
                    f"the steps of this training are slower than they could be, since they cannot "
                    f"be recorded as CUDA graphs: {error}",
                    stacklevel=2,
                )
            return None


def recorder_for(device: torch.device, wanted: bool) -> Recorder | None:
    """Return who records work on a device, or None where nobody can or it is not wanted."""
    if not wanted or device.type != "cuda" or not graphs.can_record():
        return None
    return graphs.GraphRecorder(device)
