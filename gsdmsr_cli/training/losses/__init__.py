"""Terms of the training's loss, one file per term.

The photometric loss (``ops.photometric``) is always there; where it stands alone, engines
draw, compare and differentiate in one go. Further terms are named by a preset under
``losses.terms``. A term is a module of this package with ``Options``, a frozen dataclass of its
settings, and ``start(options) -> Term``. Terms never import one another.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground import plugins
from gsdmsr_cli.model.layer import Instant, options_of
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.decoding import DECODERS
from gsdmsr_cli.scene.pictures import HalvedPictures, Pictures
from gsdmsr_cli.scene.scene import MASK, View

KIND = "term of the loss"


def _as_recorded(camera: Camera, time: float) -> Camera:
    return camera


@dataclass(frozen=True, eq=False)
class Seen:
    """What a term is given of one view.

    Attributes:
        view: of the scene; ``pictures.signal(view, name)`` reads what it has beside its picture.
        pictures: of the size that the training compares at.
        camera: of that size; for a term ``of_depth`` that of its frame.
        target: (3, H, W) uint8 true picture.
        instant, moment: when, and what is drawn.
        other_instant, other: the second instant that the term has chosen, and what the model is
            then; None unless it has an ``other_time``.
        frame: of a term ``of_depth``, see ``draw_depth``; others draw what they want to see.
        seed: of random choices, other for every view and step; 0 unless a term ``needs_seed``.
        place: returns the camera that a view is drawn by, given the scene's and the time.
    """

    view: View
    pictures: Pictures | HalvedPictures
    camera: Camera
    target: Tensor
    instant: Instant
    moment: Moment
    other_instant: Instant | None = None
    other: Moment | None = None
    frame: Frame | None = None
    seed: int = 0
    place: Callable[[Camera, float], Camera] = _as_recorded

    def camera_of(self, view: View) -> Camera:
        """Return the camera that a view is drawn by, in the size that is drawn."""
        return self.place(self.pictures.camera(view), view.time)

    def counted(self) -> Tensor | None:
        """Return which pixels (H, W) of the camera the view's mask leaves, or None for all."""
        mask = self.pictures.signal(self.view, MASK)
        if mask is None:
            return None
        height, width = self.camera.height, self.camera.width
        if mask.shape != (height, width):
            mask = DECODERS[MASK].shrink(mask, (width, height))
        return mask.to(self.moment.splats.means.device)


class Term(ABC):
    """A scalar that is added to the photometric loss of every view.

    Attributes:
        needs_seed: whether it makes random choices, which follow from ``Seen.seed``.
        of_depth: whether it is about how far away the canonical splats are: it is given a frame of
            its own, its gradient reaches them alone, no motion nor further layer, and it has no
            part once they stay as they are, as after the first moment of a stream.
        shrink: of a term ``of_depth``, both sides of its frame are divided by this.
        every: in every how many-th step it counts, as many times; in the others it costs nothing.
    """

    needs_seed: ClassVar[bool] = False
    of_depth: ClassVar[bool] = False
    shrink: int = 1
    every: int = 1

    def weight(self, progress: float) -> float:
        """Return the factor of the term at ``progress`` in [0, 1]; with 0 it costs nothing."""
        return 1.0

    def begin(self, views: Sequence[View], engine: Engine) -> str | None:
        """Learn of what there is to train on, once, before any process is forked.

        Args:
            views: the train views.
            engine: what draws.

        Returns:
            what the user is to know of it, such as that the term has nothing to compare.
        """
        return None

    def cache_in(self, folder: Path) -> None:  # noqa: B027  (most have nothing to keep)
        """Keep in the run folder what is costly to compute again."""

    def other_time(
        self, view: View, times: Sequence[float], generator: torch.Generator
    ) -> float | None:
        """Return a second time in [0, 1] at which the term wants the model, or None.

        Args:
            view: that is to be seen.
            times: distinct train times, ascending.
            generator: source of random choices.
        """
        return None

    @abstractmethod
    def __call__(self, seen: Seen) -> Tensor:
        """Return the value (), differentiable by the moments, or the frame if ``of_depth``."""


def start_term(settings: Mapping[str, Any]) -> Term:
    """Make the term ``settings["name"]``, with the other settings as its options.

    Raises:
        UsageError: there is no such term, or an option is unknown or out of range.
    """
    options = options_of(__name__, settings)
    module: Any = plugins.load(__name__, str(settings["name"]))
    term: Term = module.start(options)
    return term
