"""The model of a scene: canonical splats, and the layers that turn them into what is drawn."""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import NAMES, Splats
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.model.folding import apply, join, mask_gradients, split
from gsdmsr_cli.model.layer import Instant, Layer
from gsdmsr_cli.model.parameter import Parameter, below, tensors_of
from gsdmsr_cli.ops.precision import computing_in
from gsdmsr_cli.scene.camera import Camera

STORED_AS = "splats."
STORED = tuple(STORED_AS + name for name in NAMES)
"""Names of the splats' own tensors, which have a row for each splat."""

MOVING = "motion.moving"
"""Under which name ``Model.moving`` is saved."""

MOTION, FURTHER = "motion", "layers."
"""Under which names a model's motion and its further layers stand and are saved."""


@dataclass(frozen=True)
class Share:
    """A model that has part in a picture.

    Attributes:
        weight: of its picture in the mean.
        model: which is drawn.
        instant: at which it is drawn, in its own time.
    """

    weight: float
    model: Model
    instant: Instant


class Model:
    """N canonical splats and the layers that they go through; mutable, since training changes both.

    Attributes:
        splats: all of them, those that move first: taking them apart then copies nothing. Their
            tensors are the same objects for good.
        layers: by name, the motion first, in the order in which they are applied; those that say
            ``before_motion`` are applied before all others.
        moving: how many splats move; the others stay where they are at all times, and go only
            through layers that concern them.
        precision: what fields compute in on a GPU, see ``ops.precision``.
    """

    def __init__(
        self,
        splats: Splats,
        layers: Mapping[str, Layer],
        moving: int | None = None,
        precision: str = "float32",
    ) -> None:
        self.splats = splats.map(lambda t: torch.nn.Parameter(t.detach().contiguous()))
        self.layers = dict(layers)
        self.moving = len(splats) if moving is None else moving
        self.precision = precision
        own = self.splats.tensors().items()
        self._parameters = [Parameter(STORED_AS + n, t, True, n) for n, t in own]
        for key, layer in self.layers.items():
            for parameter in layer.parameters():
                self._parameters.append(replace(parameter, name=f"{key}.{parameter.name}"))

    def parameters(self) -> Sequence[Parameter]:
        """Return everything that is trained or saved, the splats' own tensors first."""
        return self._parameters

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors of all parameters by name."""
        return tensors_of(self._parameters)

    def trained(self) -> dict[str, Tensor]:
        """Return the tensors that follow a learning rate, by name."""
        return tensors_of(p for p in self._parameters if p.rate is not None)

    @property
    def steady(self) -> bool:
        """Whether row i of what is drawn is the same splat at all times."""
        return True

    def steadied(self) -> Model:
        """Return what is drawn as a model of which row i is the same splat at all times."""
        return self

    @property
    def shades(self) -> bool:
        """Whether a layer makes colours anew from what has been drawn."""
        return any(layer.shades for layer in self.layers.values())

    @property
    def needs_camera(self) -> bool:
        """Whether what is drawn depends on the camera that looks at it."""
        return any(layer.needs_camera for layer in self.layers.values())

    @property
    def needs_jitter(self) -> bool:
        """Whether a layer wants a random number with every instant of a training."""
        return any(layer.needs_jitter for layer in self.layers.values())

    @property
    def holds_views(self) -> bool:
        """Whether a layer holds something of each picture of the capture."""
        return any(layer.holds_views for layer in self.layers.values())

    def instant(self, time: float, camera: Camera | None = None, jitter: float = 0.0) -> Instant:
        """Return the instant with what the layers want to know of it, and no more.

        So views that differ in nothing else share one.

        Raises:
            ValueError: a layer ``needs_camera``, and there is none.
        """
        if self.needs_camera and camera is None:
            raise ValueError("what this model shows depends on the camera, and none is given")
        seen_by = camera if self.needs_camera else None
        return Instant(time, seen_by, jitter if self.needs_jitter else 0.0)

    def instant_of_view(
        self, time: float, camera: Camera, jitter: float = 0.0
    ) -> tuple[Instant, Camera]:
        """Return the instant of a picture of the capture, and the camera that it is drawn by.

        ``camera`` is the scene's. ``instant`` is for cameras that have no picture there.
        """
        if not self.holds_views:
            return self.instant(time, camera, jitter), camera
        placed = self.placed(camera, time)
        return replace(self.instant(time, placed, jitter), view=camera), placed

    def placed(self, camera: Camera, time: float) -> Camera:
        """Return the camera that a view of the capture is drawn by; ``camera`` is the scene's."""
        for layer in self._holding_views():
            camera = layer.place(camera, time)
        return camera

    def as_seen(self, moment: Moment, instant: Instant) -> Moment:
        """Return what is drawn of the moment: as the view of the capture shows it, if it is one.

        Gradients reach what layers hold of the view as well.
        """
        if instant.view is not None:
            for layer in self._holding_views():
                moment = layer.as_seen(moment, instant)
        return moment

    def tell_views(self, views: Sequence[tuple[Camera, float]]) -> dict[str, Any]:
        """Return what layers have to say of how views of the capture are drawn, by layer."""
        found = {key: layer.tell_views(views) for key, layer in self.layers.items()}
        return {key.removeprefix(FURTHER): told for key, told in found.items() if told}

    def _holding_views(self) -> list[Layer]:
        return [layer for layer in self.layers.values() if layer.holds_views]

    def at(self, instant: Instant, gradient_mask: Tensor | None = None) -> Moment:
        """Return what is drawn at ``instant``, see ``at_instants``."""
        return self.at_instants([instant], gradient_mask)[0]

    def at_instants(
        self, instants: Sequence[Instant], gradient_mask: Tensor | None = None
    ) -> list[Moment]:
        """Return what is drawn at each of the instants.

        Args:
            instants: the first layer goes to all of them at once if it can.
            gradient_mask: (N,) bool, the splats whose gradients reach the layers; all if
                None. The others pass theirs to their canonical values alone, as if what layers
                add to them were constant.
        """
        canonical = Moment(self.splats)
        with computing_in(self.precision):
            begun = self._begun(canonical, instants[0])
            if any(layer.needs_turns for layer in self.layers.values()):
                begun = replace(begun, canonical_quats=begun.splats.quats)
            moments = [begun] * len(instants)
            for layer in self._before_motion(False):
                moments = self._through(layer, moments, instants)
        if gradient_mask is None:
            return moments
        return [mask_gradients(canonical, moment, gradient_mask) for moment in moments]

    def shares(self, instant: Instant) -> list[Share]:
        """Return whose pictures make the picture of an instant, which is their weighted mean."""
        return [Share(1.0, self, instant)]

    def canonical(self) -> Moment:
        """Return what the motion is given: the canonical splats after the layers before it."""
        with computing_in(self.precision):
            return self._begun(Moment(self.splats), Instant(0.0))

    def _begun(self, canonical: Moment, instant: Instant) -> Moment:
        """Return the canonical splats after the layers before the motion, whatever the instant."""
        moments = [canonical]
        for layer in self._before_motion(True):
            moments = self._through(layer, moments, [instant])
        return moments[0]

    def shade(self, frame: Frame, instant: Instant) -> Frame:
        """Return the frame after all layers that make colours anew."""
        for layer in self.layers.values():
            if layer.shades:
                frame = layer.shade(frame, instant)
        return frame

    def _before_motion(self, wanted: bool) -> list[Layer]:
        """Return the layers that are applied before the motion, or the motion and those after."""
        return [layer for layer in self.layers.values() if layer.before_motion is wanted]

    def _through(
        self, layer: Layer, moments: list[Moment], instants: Sequence[Instant]
    ) -> list[Moment]:
        """Return the moments after a layer, which is given the splats that concern it."""
        count = self._rows(layer)
        if count == len(self.splats):
            return apply(layer, moments, instants)
        if not count:
            return moments
        parts = {moment: split(moment, count) for moment in moments}
        given = [parts[moment][0] for moment in moments]
        after = apply(layer, given, instants)
        return [
            join(moment, *parts[moment], moved)
            for moment, moved in zip(moments, after, strict=True)
        ]

    def _rows(self, layer: Layer) -> int:
        """Return how many splats go through a layer: always the first ones."""
        return len(self.splats) if layer.concerns_still else self.moving

    def advance(self, progress: float) -> None:
        """Let every layer enter the phase that belongs to ``progress`` in [0, 1]."""
        for layer in self.layers.values():
            layer.advance(progress)

    def hold_outside(self, first: float, last: float) -> None:
        """Let the layers be, at times that no view has shown yet, as at the nearest shown.

        Args:
            first, last: the times within which views have been shown. What has no values of single
                times, such as a polynomial, is not changed.
        """
        for parameter in self.parameters():
            parameter.hold_outside(first, last)

    def constants(self) -> Hashable | None:
        """Return what else than parameters and times ``at_instants`` hangs on; see ``Layer``.

        None if a layer cannot be recorded.
        """
        if self.needs_camera or self.needs_jitter or self.holds_views or self.shades:
            return None
        own: list[object] = [len(self.splats), self.moving, self.precision]
        for layer in self.layers.values():
            if layer.constants is None:
                return None
            own += (getattr(layer, name) for name in layer.constants)
        return tuple(own)

    def penalty(self, instant: Instant, generator: torch.Generator) -> Tensor | None:
        """Return the sum of the layers' regularisers at ``instant``, or None if there are none."""
        total: Tensor | None = None
        with computing_in(self.precision):
            for layer in self.layers.values():
                if not (count := self._rows(layer)):
                    continue
                value = layer.penalty(Moment(self._firsts(count)), instant, generator)
                if value is not None:
                    total = value if total is None else total + value
        return total

    def _firsts(self, count: int) -> Splats:
        """Return the first splats, without a copy."""
        return self.splats.map(lambda tensor: tensor[:count])

    def take(self, rows: Tensor, fresh: Tensor) -> None:
        """Make row i what row ``rows[i]`` was.

        The one resize verb: clone, split, prune and reorder. For every layer ``take`` then ``at``
        equals ``at`` then ``take``. As many splats move afterwards as rows of moving ones are
        named, which must be the first.

        Args:
            rows: (M,) int64.
            fresh: (M,) bool, rows that are clones or children.

        Raises:
            ValueError: the row of a splat that moves comes after one of a splat that does not.
        """
        moving = int((rows < self.moving).sum())
        if not (rows[:moving] < self.moving).all():
            raise ValueError("rows of splats that move come after rows of splats that stand still")
        self.take_moving(rows, fresh, moving)

    def take_moving(self, rows: Tensor, fresh: Tensor, moving: int) -> None:
        """Do what ``take`` does, and let only the first ``moving`` rows move from now on.

        Those among them that have stood still get new rows in layers that have had none of them,
        see ``Parameter.fill``.

        Raises:
            IndexError: there is no such row.
        """
        if len(rows) and int(rows.max()) >= len(self.splats):
            raise IndexError(f"row {int(rows.max())} of {len(self.splats)} splats")
        for parameter in self._parameters[: len(NAMES)]:
            parameter.take(rows)
        self.moving = moving
        for layer in self.layers.values():
            count = self._rows(layer)
            layer.take(rows[:count], fresh[:count])

    def become(self, count: int, moving: int) -> None:
        """Take the shapes of a model of so many splats; all values must then be set anew."""
        self.moving = len(self.splats)  # for once, so that rows of any kind may be taken
        for parameter in self._parameters:
            if parameter.per_splat and not len(parameter.tensor):  # there is a row to take
                parameter.set_values(parameter.tensor.new_zeros(1, *parameter.tensor.shape[1:]))
        rows = torch.zeros(count, dtype=torch.int64)
        self.take_moving(rows, rows > 0, moving)

    @torch.no_grad()
    def to_split(self) -> Tensor:
        """Return which splats a layer wants to be split rather than cloned, (N,) bool."""
        found = torch.zeros(len(self.splats), dtype=torch.bool, device=self.splats.means.device)
        for layer in self.layers.values():
            own = layer.to_split()
            if own is not None:
                found[: len(own)] |= own
        return found

    @torch.no_grad()
    def highest_opacities(self) -> Tensor:
        """Return the logits of the most that splats are opaque at any time of the capture, (N,)."""
        found = self.splats.logit_opacities.clone()
        for layer in self.layers.values():
            if count := self._rows(layer):
                given = replace(self._firsts(count), logit_opacities=found[:count])
                found[:count] = layer.highest_opacities(given)
        return found

    @torch.no_grad()
    def scatter(self, children: Tensor, shrink: float, generator: torch.Generator) -> None:
        """Let layers tell the children (N,) of splits apart, see ``Layer.scatter``."""
        for layer in self.layers.values():
            count = self._rows(layer)
            if children[:count].any():
                layer.scatter(children[:count], self._firsts(count), shrink, generator)

    @torch.no_grad()
    def reanchor(self) -> list[str]:
        """Adapt layers to the present splats; return the names of the parameters that changed."""
        changed = []
        for key, layer in self.layers.items():
            if count := self._rows(layer):
                changed += [f"{key}.{name}" for name in layer.reanchor(self._firsts(count))]
        return changed

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Give the layers the values of a file, see ``Layer.restore``.

        Raises:
            DataError: a tensor is missing, or does not fit.
        """
        for key, layer in self.layers.items():
            try:
                layer.restore(below(f"{key}.", tensors), self._rows(layer))
            except ValueError as error:
                raise DataError(f"the checkpoint holds {error}") from error

    def to(self, device: torch.device | str) -> Model:
        """Move everything to a device, in place, and return the model."""
        for parameter in self._parameters:
            parameter.set_values(parameter.tensor.to(device))
        return self
