"""Renders views as the preset wants them at each phase of a training, and goes backward."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.measure import Measure
from gsdmsr_cli.ground.splatting_constants import tile_grid
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.options.preset import BACKGROUNDS, Preset
from gsdmsr_cli.raster import ComparingViews, Engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.pictures import HalvedPictures, Pictures, ResidentPictures
from gsdmsr_cli.scene.scene import MASK, MOVING, View
from gsdmsr_cli.training.gradients.compare import Moving, compare, compare_views, sum_of
from gsdmsr_cli.training.gradients.depth_terms import add_depth_terms
from gsdmsr_cli.training.gradients.phase import Order, Phase, ViewGradients
from gsdmsr_cli.training.gradients.replays import Replays, ViewInputs, recorder_for
from gsdmsr_cli.training.losses import Seen, start_term


class _Look(NamedTuple):
    """A view as it is drawn and compared.

    Attributes:
        others: second instants, of each term of the loss; None where it has none.
    """

    order: Order
    view: View
    pictures: Pictures | HalvedPictures
    instant: Instant
    camera: Camera
    target: Tensor
    mask: Tensor | None
    moving: Moving | None
    others: tuple[Instant | None, ...]

    @property
    def instants(self) -> list[Instant]:
        """Return all at which the model is wanted."""
        return [self.instant, *(other for other in self.others if other is not None)]

    def seen(
        self, model: Model, moment: Moment, camera: Camera, frame: Frame | None = None
    ) -> Seen:
        """Return what a term is given that has no second instant."""
        return Seen(
            self.view, self.pictures, camera, self.target, self.instant, moment, frame=frame,
            seed=self.order.seed, place=model.placed,
        )  # fmt: skip


class TrainingRenderer:
    """Renders train views of a model and takes the gradients of their loss.

    Attributes:
        background: (3,) colour behind the splats, on the device.
        terms: of the loss, beside the photometric one.
        notes: what the terms have to say of the views.
    """

    def __init__(
        self,
        preset: Preset,
        engine: Engine,
        pictures: Pictures,
        views: Sequence[View],
        device: torch.device | str = "cpu",
    ) -> None:
        self.preset, self.engine, self.pictures, self.views = preset, engine, pictures, views
        self.background = torch.tensor(BACKGROUNDS[preset.data.background]).to(device)
        self.terms = [start_term(settings) for settings in preset.losses.terms]
        told = [term.begin(views, engine) for term in self.terms]
        self.notes = [text for text in told if text is not None]
        self._halved = HalvedPictures(pictures)
        self._resident = ResidentPictures(torch.device(device), preset.data.cache_mib << 20)
        self._replays = Replays(recorder_for(torch.device(device), preset.training.cuda_graphs))
        self._mask: Tensor | None = None

    def cache_in(self, folder: Path) -> None:
        """Let terms keep in a run folder what is costly to compute; before workers are forked."""
        for term in self.terms:
            term.cache_in(folder)

    def renders_at_once(self, model: Model) -> bool:
        """Return whether further views of a step cost little, in all phases of the training.

        They do if the engine renders views at once, which it does if their pictures are of one
        size. Terms of the loss are asked of one view after the other.
        """
        losses = self.preset.losses
        masks = {MASK, MOVING} if losses.moving_weight else {MASK}
        whole = not any(masks & view.signals.keys() for view in self.views)
        return whole and not (losses.terms or losses.inliers < 1 or model.shades)

    def gradients(self, model: Model, orders: Sequence[Order], phase: Phase) -> list[ViewGradients]:
        """Return what each of the ordered views says of the model.

        Views are rendered at once if the engine can and their pictures are of one size.

        Args:
            model: what is rendered.
            orders: tiles may be weighted only where ``tiles`` allows it.
            phase: of the training.

        Raises:
            DataError: a view's picture cannot be read.
        """
        looks = [self._look(model, order, phase) for order in orders]
        if self._can_be_at_once(model, looks):
            return self._at_once(model, looks, phase)
        return [self._alone(model, look, phase) for look in looks]

    def _look(self, model: Model, order: Order, phase: Phase) -> _Look:
        pictures, view = self.pictures_at(phase.progress), self.views[order.row]
        recorded, weights = pictures.camera(view), self._weights(phase)
        instant, camera = model.instant_of_view(view.time, recorded, order.jitter)
        times = order.other_times or [None] * len(self.terms)
        others = tuple(
            None if time is None or not weight > 0 else model.instant(time, camera, order.jitter)
            for time, weight in zip(times, weights, strict=True)
        )
        target, mask = self._resident.load(pictures, view), pictures.signal(view, MASK)
        moving = self._moving(pictures, view)
        return _Look(order, view, pictures, instant, camera, target, mask, moving, others)

    def _moving(self, pictures: Pictures | HalvedPictures, view: View) -> Moving | None:
        """Return the pixels of a view that count more than others, None if none do."""
        weight = self.preset.losses.moving_weight
        mask = pictures.signal(view, MOVING) if weight else None
        return None if mask is None else Moving(mask, weight)

    def _can_be_at_once(self, model: Model, looks: Sequence[_Look]) -> bool:
        able = isinstance(self.engine, ComparingViews) and not model.shades
        whole = self.preset.losses.inliers == 1
        whole = whole and all(look.mask is None and look.moving is None for look in looks)
        weights = [look.order.tile_weights for look in looks]
        return able and whole and _alike([look.camera for look in looks], weights)

    def _at_once(self, model: Model, looks: Sequence[_Look], phase: Phase) -> list[ViewGradients]:
        known = self._known(model, looks, phase)
        if known is not None:
            return self._replayed(known, model, looks, phase)
        moments = self._moved(model, [i for look in looks for i in look.instants], phase)
        seen = [model.as_seen(moments[look.instant], look.instant) for look in looks]
        further = [self._further(model, look, moments, phase) for look in looks]
        found = self._compared(model, looks, seen, further, phase)
        return [
            self._with_depth_terms(own, model, look, moments[look.instant], phase)
            for own, look in zip(found, looks, strict=True)
        ]

    def _compared(
        self,
        model: Model,
        looks: Sequence[_Look],
        moments: Sequence[Moment],
        further: Sequence[Tensor | None],
        phase: Phase,
    ) -> list[ViewGradients]:
        assert isinstance(self.engine, ComparingViews)
        return compare_views(
            self.engine, model, moments, [look.camera for look in looks], self.background,
            [look.target for look in looks], self._measure(phase.progress, phase.frozen),
            self._sh_degree(phase.progress),
            [self._on_device(look.order.tile_weights) for look in looks], further,
        )  # fmt: skip

    def _known(self, model: Model, looks: Sequence[_Look], phase: Phase) -> Hashable | None:
        """Return all but the views that their gradients hang on, or None if not all is known."""
        constants = model.constants() if self._replays.able and not self.terms else None
        if constants is None or any(look.order.tile_weights is not None for look in looks):
            return None
        camera, mask = looks[0].camera, phase.gradient_mask
        return (
            len(looks), camera.width, camera.height, phase.moving, mask is not None,
            self._measure(phase.progress, phase.frozen), self._sh_degree(phase.progress),
            constants, tuple((p.tensor.data_ptr(), p.tensor.shape) for p in model.parameters()),
        )  # fmt: skip

    def _replayed(
        self, known: Hashable, model: Model, looks: Sequence[_Look], phase: Phase
    ) -> list[ViewGradients]:
        """Return the gradients by work that is the same for all views, to be replayed."""
        mask = self._kept_mask(phase.gradient_mask)
        instants = [look.instant for look in looks]
        inputs = ViewInputs(
            [look.camera for look in looks], [instant.time for instant in instants],
            [look.target for look in looks],
        )  # fmt: skip

        def work() -> list[ViewGradients]:
            # two views of one time are two here, as they are of two times when it is replayed
            moments = (
                model.at_instants(instants, mask)
                if phase.moving
                else [Moment(model.splats)] * len(looks)
            )
            return self._compared(model, looks, moments, [None] * len(looks), phase)

        return self._replays.run((known, None if mask is None else mask.data_ptr()), inputs, work)

    def _kept_mask(self, mask: Tensor | None) -> Tensor | None:
        """Return the mask where the masks of all steps lie."""
        if mask is None:
            return None
        if self._mask is None or self._mask.shape != mask.shape:
            self._mask = torch.empty_like(mask)
        return self._mask.copy_(mask)

    def _alone(self, model: Model, look: _Look, phase: Phase) -> ViewGradients:
        moments = self._moved(model, look.instants, phase)
        moment = moments[look.instant]
        found = compare(
            self.engine, model, model.as_seen(moment, look.instant), look.instant, look.camera,
            self.background, look.target, self._measure(phase.progress, phase.frozen),
            self._sh_degree(phase.progress), self._on_device(look.order.tile_weights), look.mask,
            self.preset.losses.inliers, phase.screens, self._further(model, look, moments, phase),
            look.moving,
        )  # fmt: skip
        return self._with_depth_terms(found, model, look, moment, phase)

    def _further(
        self, model: Model, look: _Look, moments: Mapping[Instant, Moment], phase: Phase
    ) -> Tensor | None:
        """Return the sum of the terms but for those about depth, or None if none counts.

        They say nothing of where views are from, so their moments are not traced.
        """
        values = []
        for term, weight, other in zip(self.terms, self._weights(phase), look.others, strict=True):
            if weight > 0 and not term.of_depth:
                then = None if other is None else moments[other]
                seen = look.seen(model, moments[look.instant], look.camera)
                values.append(weight * term(replace(seen, other_instant=other, other=then)))
        return sum_of(values)

    def _with_depth_terms(
        self, found: ViewGradients, model: Model, look: _Look, moment: Moment, phase: Phase
    ) -> ViewGradients:
        weighted = zip(self.terms, self._weights(phase), strict=True)
        counting = [(term, weight) for term, weight in weighted if term.of_depth and weight > 0]
        if not counting:
            return found
        seen = partial(look.seen, model)
        return add_depth_terms(found, counting, seen, moment, look.camera, model, self.engine)

    def _weights(self, phase: Phase) -> list[float]:
        """Return the factor of each term in this step."""
        return [
            0.0
            if phase.step % term.every or (phase.frozen and term.of_depth)
            else term.every * term.weight(phase.progress)
            for term in self.terms
        ]

    def other_times(
        self, view: View, times: Sequence[float], generator: torch.Generator
    ) -> tuple[float | None, ...]:
        """Return the second time that each term wants for a view, see ``Term.other_time``."""
        return tuple(term.other_time(view, times, generator) for term in self.terms)

    def seed(self, generator: torch.Generator) -> int:
        """Return the seed of the terms' random choices for a view, 0 if they make none."""
        if not any(term.needs_seed for term in self.terms):
            return 0
        return int(torch.randint(2**62, (), generator=generator))

    def _moved(
        self, model: Model, instants: Sequence[Instant], phase: Phase
    ) -> dict[Instant, Moment]:
        """Return the model at each of the instants."""
        distinct = list(dict.fromkeys(instants))
        if not phase.moving:
            return dict.fromkeys(distinct, Moment(model.splats))
        moved = model.at_instants(distinct, phase.gradient_mask)
        return dict(zip(distinct, moved, strict=True))

    def _on_device(self, tile_weights: Tensor | None) -> Tensor | None:
        return None if tile_weights is None else tile_weights.to(self.background.device)

    def tiles(self, view: View, progress: float, frozen: bool) -> int:
        """Return how many tiles a view's picture has, or 0 where they may not be chosen.

        ``frozen`` is as in ``Phase``.
        """
        if self._measure(progress, frozen).ssim > 0:
            return 0
        camera = self.camera(view, progress)
        return math.prod(tile_grid(camera.width, camera.height))

    def camera(self, view: View, progress: float) -> Camera:
        """Return the camera that a view is rendered under."""
        return self.pictures_at(progress).camera(view)

    def pictures_at(self, progress: float) -> Pictures | HalvedPictures:
        """Return the pictures that views are compared with, of half the size at first."""
        if progress < self.preset.training.low_resolution_until:
            return self._halved
        self._halved.release()
        return self.pictures

    def _measure(self, progress: float, frozen: bool) -> Measure:
        """Return how pictures are compared; ``frozen`` is as in ``Phase``."""
        losses = self.preset.losses
        if frozen:
            return Measure(self.preset.stream.ssim)
        ssim = losses.ssim if progress < losses.ssim_until else 0.0
        return Measure(ssim, losses.quadratic if progress >= losses.quadratic_from else 0.0)

    def _sh_degree(self, progress: float) -> int:
        """Return the degree of colour; degree d joins at d times ``sh_start``."""
        options = self.preset.splats
        if options.sh_start <= 0:
            return options.sh_degree
        return min(options.sh_degree, int(progress / options.sh_start))


def _alike(cameras: Sequence[Camera], tile_weights: Sequence[Tensor | None]) -> bool:
    """Return whether views can be rendered together."""
    sizes = {(camera.width, camera.height) for camera in cameras}
    return len(sizes) == 1 and len({weights is None for weights in tile_weights}) == 1
