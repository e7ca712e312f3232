"""Layers turn the canonical splats, one after another, into what is drawn at an instant.

A motion is a layer; so are an opacity that changes in time, a mask, or a colour that is read from a
field.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground import plugins
from gsdmsr_cli.model.parameter import Parameter, tensors_of
from gsdmsr_cli.ops.planes import Box
from gsdmsr_cli.options import strict
from gsdmsr_cli.scene.camera import Camera


@dataclass(frozen=True)
class Facts:
    """What a layer may know of its scene; saved with every run.

    Attributes:
        bound: half edge of the cube around the origin that holds the scene [world units].
        box: lower and upper corner of where the canonical splats are [world units].
        frames: number of distinct train times.
    """

    bound: float
    box: Box
    frames: int


@dataclass(frozen=True)
class Instant:
    """When, and for layers that ask for it from where, the splats are wanted.

    Attributes:
        time: in [0, 1].
        camera: that they are seen by; None unless a layer ``needs_camera``.
        jitter: a standard normal random number of this view and step, on which all processes
            agree; 0 outside training and unless a layer ``needs_jitter``.
        view: the camera, as the scene has it, of the capture's picture that is drawn; None where
            none is, and unless a layer ``holds_views``.
    """

    time: float
    camera: Camera | None = None
    jitter: float = 0.0
    view: Camera | None = None


@dataclass(frozen=True, eq=False)
class Following:
    """What the splats of a layer follow, as ``ops.skin`` has it.

    Attributes:
        points: (B, 3) canonical places [world units].
        log_radii: (B,) how far they reach; None where a splat follows one alone.
        near: how many of the nearest a splat follows, or (N,) int64, the one that it follows.
        movement: returns (B, 10) of the points at a time in [0, 1], see ``ops.skin.transforms``.
    """

    points: Tensor
    log_radii: Tensor | None
    near: int | Tensor
    movement: Callable[[float], Tensor]


class Layer(ABC):
    """One step from the canonical splats to what is drawn; mutable, since training changes it.

    Attributes:
        identity_at_start: whether a new layer leaves the splats as they are, at all times.
        concerns_still: whether splats that stand still go through this layer too. If not, it is
            given, and holds, only those that move.
        before_motion: whether it is applied before the motion, to the canonical splats, whatever
            the instant; of two such layers in the order of the preset's list.
        needs_camera, needs_jitter: what it wants to know of an instant beside the time.
        needs_turns: whether it wants to know of a moment what rotations splats had before the
            motion.
        shades: whether ``shade`` does anything.
        holds_views: whether it holds something of each picture of the capture, and does nothing
            where none of these is drawn.
        constants: names of the attributes that ``at_instants`` and ``at_moments`` read beside
            parameters and times, and that may change as it trains. While they stay the same a GPU
            may replay its launches, for which all times are to be read as ``recording.vary`` has
            it, of all instants at once; None if they are not.
    """

    identity_at_start: bool = True
    concerns_still: ClassVar[bool] = False
    before_motion: ClassVar[bool] = False
    needs_camera: ClassVar[bool] = False
    needs_jitter: bool = False
    needs_turns: ClassVar[bool] = False
    shades: ClassVar[bool] = False
    holds_views: ClassVar[bool] = False
    constants: ClassVar[Sequence[str] | None] = None

    def __init__(self, parameters: Sequence[Parameter] = ()) -> None:
        self._parameters = tuple(parameters)

    @abstractmethod
    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moment after this layer; row i of the result is row i of ``moment``."""

    def at_instants(self, moment: Moment, instants: Sequence[Instant]) -> list[Moment]:
        """Return what ``at`` does at each of the instants, with less work where possible."""
        return self.at_moments([moment] * len(instants), instants)

    def at_moments(self, moments: Sequence[Moment], instants: Sequence[Instant]) -> list[Moment]:
        """Return what ``at`` does with each moment at its instant, with less work if possible."""
        return [self.at(moment, now) for moment, now in zip(moments, instants, strict=True)]

    def shade(self, frame: Frame, instant: Instant) -> Frame:
        """Return the frame with colours made anew from what was drawn, such as features."""
        return frame

    def place(self, camera: Camera, time: float) -> Camera:
        """Return the camera that a picture of the capture is drawn by; ``camera`` is the scene's.

        Called of layers that hold views alone.
        """
        return camera

    def as_seen(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moment as the view ``instant.view`` shows it; the last thing before drawing.

        Such as in its colours, or as it is with gradients that reach what ``place`` goes by.
        """
        return moment

    def tell_views(self, views: Sequence[tuple[Camera, float]]) -> dict[str, Any]:
        """Return what a report is to say of how these views are drawn, plain JSON."""
        return {}

    def parameters(self) -> Sequence[Parameter]:
        """Return everything that is trained or saved, in a fixed order, under fixed names."""
        return self._parameters

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors of the parameters by name."""
        return tensors_of(self.parameters())

    def take(self, rows: Tensor, fresh: Tensor) -> None:
        """Follow a resize: row i of what is held per splat becomes what row ``rows[i]`` was.

        Args:
            rows: (M,) int64; those beyond what is held are of splats that begin to move.
            fresh: (M,) bool, rows that are clones or children.
        """
        for parameter in self.parameters():
            if parameter.per_splat:
                parameter.take(rows)

    def restore(self, tensors: Mapping[str, Tensor], count: int) -> None:
        """Take the values of a file, whose shapes may differ from those that a start gives.

        Args:
            tensors: by the names of ``parameters``, perhaps among others.
            count: rows of what is held per splat.

        Raises:
            ValueError: a tensor is missing, or of another kind than this layer's.
        """
        for parameter in self.parameters():
            saved, own = tensors.get(parameter.name), parameter.tensor
            if saved is None:
                raise ValueError(f"nothing for '{parameter.name}'")
            found = f"shape {tuple(saved.shape)} {saved.dtype} for '{parameter.name}'"
            if saved.dim() != own.dim() or saved.dtype != own.dtype:
                raise ValueError(f"{found}, not {own.dim()} dimensions of {own.dtype}")
            if parameter.per_splat and saved.shape != (count, *own.shape[1:]):
                raise ValueError(f"{found}, not {(count, *own.shape[1:])}")
            parameter.set_values(saved.to(own.device).clone())
        self.check()

    def check(self) -> None:  # noqa: B027  (most have nothing to check)
        """Raise ValueError unless the shapes of the tensors fit together."""

    def advance(self, progress: float) -> None:  # noqa: B027  (most have no phases)
        """Enter the phase of training that belongs to ``progress`` in [0, 1]."""

    def to_split(self) -> Tensor | None:
        """Return which splats are split rather than cloned if they grow, (N,) bool, or None.

        Those that are large in what this layer holds, such as time; density control knows of those
        that are large in space.
        """
        return None

    def highest_opacities(self, splats: Splats) -> Tensor:
        """Return the logits (N,) of the most that splats are opaque at any time of the capture.

        By it density control prunes them. A layer that lets splats live for a while overrides it.
        """
        return splats.logit_opacities

    def scatter(  # noqa: B027  (most hold nothing that children differ in)
        self, children: Tensor, splats: Splats, shrink: float, generator: torch.Generator
    ) -> None:
        """Tell the children of splits apart, which so far hold what their parents did.

        Called without a graph after ``take``.

        Args:
            children: (N,) bool, which splats are such.
            splats: N, whose means lie apart and whose scales are less already; may be changed in
                place.
            shrink: by what the children's extents are divided.
            generator: source of random choices.
        """

    def begin_at(self, times: Tensor) -> None:  # noqa: B027  (most have no time of each splat)
        """Take the times (N,) at which the first splats were seen, NaN where that is not known."""

    def begin_with(self, views: Sequence[tuple[Camera, float]]) -> None:  # noqa: B027  (likewise)
        """Take the cameras and times of the train views, to hold something of each."""

    def reanchor(self, splats: Splats) -> Sequence[str]:
        """Adapt the layer to where the splats are now, since there are others than before.

        Called without a graph as motion begins and after splats were grown. Shapes stay.

        Returns:
            the names of the parameters that have new values.
        """
        return ()

    def following(self) -> Following | None:
        """Return what splats follow, if this layer does no more than let them follow it."""
        return None

    def lives(self, splats: Splats) -> Tensor | None:
        """Return when the N splats that it is given are there, (N, 4), or None if always.

        The columns are the first and the last time at which a splat is there in full, and natural
        logarithms of two durations d: of appearing and of vanishing. At a distance e before the
        first or after the last time exp(-(e / d)^2) of its opacity is left.
        """
        return None

    def kept(self) -> Tensor | None:
        """Return which of the splats that it is given are ever drawn, (N,) bool; None if all."""
        return None

    def fit(self, splats: Splats, generator: torch.Generator) -> None:  # noqa: B027  (most do not)
        """Fit what is not learnt by steps, such as codebooks, to the splats as they are now.

        The event ``codebooks`` calls it, without a graph.
        """

    def penalty(
        self, moment: Moment, instant: Instant, generator: torch.Generator
    ) -> Tensor | None:
        """Return the layer's regularisers at the present values, or None if it has none.

        What depends on positions or time is evaluated for ``moment``, what the layer is given, at
        ``instant``; ``generator`` is the source of random choices.
        """
        return None


def options_of(package: str, settings: Mapping[str, Any]) -> Any:
    """Return the ``Options`` that ``settings`` ask for, of the plug-in ``settings["name"]``.

    Raises:
        UsageError: no plug-in of the package has that name, or an option is unknown or out of
            range.
    """
    module: Any = plugins.load(package, str(settings.get("name", "")))
    located = settings if isinstance(settings, strict.Located) else strict.Located(settings)
    return strict.build(module.Options, located.without("name"), package.rpartition(".")[2])


def start_layer(
    package: str,
    settings: Mapping[str, Any],
    facts: Facts,
    splats: Splats,
    generator: torch.Generator,
) -> Layer:
    """Make the layer ``settings["name"]`` of a package, with the other settings as its options.

    Args:
        package: whose modules have ``Options`` and
            ``start(options, facts, splats, generator) -> Layer``.
        settings: from a preset.
        facts: of the scene.
        splats: those that go through the layer.
        generator: source of random choices.

    Raises:
        UsageError: see ``options_of``.
    """
    options = options_of(package, settings)
    module: Any = plugins.load(package, str(settings["name"]))
    layer: Layer = module.start(options, facts, splats, generator)
    return layer
