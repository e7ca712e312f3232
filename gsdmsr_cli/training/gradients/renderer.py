"""Renders views as the preset wants them at each phase of a training, and goes backward."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.splatting_constants import tile_grid
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.options.preset import BACKGROUNDS, Preset
from gsdmsr_cli.raster import ComparingViews, Engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.pictures import HalvedPictures, Pictures, ResidentPictures
from gsdmsr_cli.scene.scene import MASK, View
from gsdmsr_cli.training.gradients.compare import (
    compare,
    compare_views,
    differentiate,
    draw_and_compare,
)
from gsdmsr_cli.training.gradients.depth_terms import add_depth_terms
from gsdmsr_cli.training.gradients.phase import Order, Phase, ViewGradients
from gsdmsr_cli.training.losses import Seen, start_term


class _Look(NamedTuple):
    """A view as it is drawn and compared."""

    order: Order
    view: View
    pictures: Pictures | HalvedPictures
    instant: Instant
    camera: Camera
    target: Tensor

    def seen(self, model: Model) -> dict[str, Any]:
        """Return what terms of the loss are given of it, but for what was drawn."""
        order, view, pictures, instant, _, target = self
        given = {"view": view, "pictures": pictures, "target": target}
        return given | {"instant": instant, "seed": order.seed, "place": model.placed}


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

    def cache_in(self, folder: Path) -> None:
        """Let terms keep in a run folder what is costly to compute; before workers are forked."""
        for term in self.terms:
            term.cache_in(folder)

    def renders_at_once(self, model: Model) -> bool:
        """Return whether the views of a step are rendered at once in all phases of the training.

        If their pictures are of one size, and the engine can.
        """
        losses = self.preset.losses
        whole = not any(MASK in view.signals for view in self.views)
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
        weighted = list(zip(self.terms, self._weights(phase), strict=True))
        if model.shades or any(not term.of_depth and weight > 0 for term, weight in weighted):
            found = [self._with_terms(model, look, phase) for look in looks]
        else:
            found = self._compared(model, looks, phase)
        of_depth = [(term, weight) for term, weight in weighted if term.of_depth and weight > 0]
        if not of_depth:
            return [of_picture for of_picture, _ in found]
        return [
            add_depth_terms(
                of_picture, of_depth, partial(Seen, **look.seen(model)), moment, look.camera, model,
                self.engine,
            )
            for (of_picture, moment), look in zip(found, looks, strict=True)
        ]  # fmt: skip

    def _look(self, model: Model, order: Order, phase: Phase) -> _Look:
        pictures, view = self._pictures(phase.progress), self.views[order.row]
        recorded = pictures.camera(view)
        instant, camera = model.instant_of_view(view.time, recorded, order.jitter)
        return _Look(order, view, pictures, instant, camera, self._resident.load(pictures, view))

    def _compared(
        self, model: Model, looks: Sequence[_Look], phase: Phase
    ) -> list[tuple[ViewGradients, Moment]]:
        """Draw and compare views, at once if the engine can; return the moments drawn as well."""
        cameras, targets = [look.camera for look in looks], [look.target for look in looks]
        masks = [look.pictures.signal(look.view, MASK) for look in looks]
        weights = [self._on_device(look.order.tile_weights) for look in looks]
        further = self._ssim_weight(phase.progress), self._sh_degree(phase.progress)
        normal = self.preset.losses.inliers
        whole = normal == 1 and all(mask is None for mask in masks)
        together = whole and _alike(cameras, weights)
        moments: Iterable[Moment] = (self._seen(model, [look.instant], phase)[0] for look in looks)
        if together and isinstance(self.engine, ComparingViews):
            moments = at_once = self._seen(model, [look.instant for look in looks], phase)
            if all(moment.features is None for moment in at_once):
                given = self.engine, model, at_once, cameras, self.background, targets
                found = compare_views(*given, *further, weights)
                return list(zip(found, at_once, strict=True))
        drawn, rest = (self.engine, model), (normal, phase.screens)
        return [
            (
                compare(
                    *drawn, moment, camera, self.background, target, *further, own, mask, *rest
                ),
                moment,
            )
            for moment, camera, target, own, mask in zip(
                moments, cameras, targets, weights, masks, strict=True
            )
        ]

    def _with_terms(self, model: Model, look: _Look, phase: Phase) -> tuple[ViewGradients, Moment]:
        """Draw, shade and compare a view, and add the terms of the loss about its picture."""
        order, instant, camera = look.order, look.instant, look.camera
        weights = self._weights(phase)
        times = order.other_times or [None] * len(self.terms)
        others = [
            None if time is None or not weight > 0 else model.instant(time, camera, order.jitter)
            for time, weight in zip(times, weights, strict=True)
        ]
        wanted = [instant, *(other for other in others if other is not None)]
        moments = dict(zip(wanted, self._moved(model, wanted, phase), strict=True))
        moment = moments[instant]
        traced = model.trace(moment, instant)  # terms say nothing of where views are from
        judged, frame = draw_and_compare(
            self.engine, model, traced, instant, camera, self.background, look.target,
            self._ssim_weight(phase.progress), self._sh_degree(phase.progress),
            self._on_device(order.tile_weights), look.pictures.signal(look.view, MASK),
            self.preset.losses.inliers,
        )  # fmt: skip
        loss = judged.loss
        for term, weight, other in zip(self.terms, weights, others, strict=True):
            if weight > 0 and not term.of_depth:
                seen = Seen(
                    **look.seen(model), camera=camera, moment=moment, frame=frame,
                    other_instant=other, other=None if other is None else moments[other],
                )  # fmt: skip
                loss = loss + weight * term(seen)
        gradients, on_screen = differentiate(loss, judged, frame, model, phase.screens)
        size = camera.width, camera.height
        found = ViewGradients(loss.detach(), gradients, on_screen, size, judged.errors)
        return found, moment

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

    def _seen(self, model: Model, instants: Sequence[Instant], phase: Phase) -> list[Moment]:
        """Return the model at each of the instants, as it is drawn."""
        moved = self._moved(model, instants, phase)
        return [model.trace(moment, now) for moment, now in zip(moved, instants, strict=True)]

    def _moved(self, model: Model, instants: Sequence[Instant], phase: Phase) -> list[Moment]:
        """Return the model at each of the instants, the very same where these are equal."""
        if not phase.moving:
            return [Moment(model.splats)] * len(instants)
        distinct = list(dict.fromkeys(instants))
        moved = model.at_instants(distinct, phase.gradient_mask)
        by_instant = dict(zip(distinct, moved, strict=True))
        return [by_instant[instant] for instant in instants]

    def _on_device(self, tile_weights: Tensor | None) -> Tensor | None:
        return None if tile_weights is None else tile_weights.to(self.background.device)

    def tiles(self, view: View, progress: float) -> int:
        """Return how many tiles a view's picture has, or 0 where they may not be chosen."""
        if self._ssim_weight(progress) > 0:
            return 0
        camera = self.camera(view, progress)
        return math.prod(tile_grid(camera.width, camera.height))

    def camera(self, view: View, progress: float) -> Camera:
        """Return the camera that a view is rendered under."""
        return self._pictures(progress).camera(view)

    def _pictures(self, progress: float) -> Pictures | HalvedPictures:
        if progress < self.preset.training.low_resolution_until:
            return self._halved
        self._halved.release()
        return self.pictures

    def _ssim_weight(self, progress: float) -> float:
        losses = self.preset.losses
        return losses.ssim if progress < losses.ssim_until else 0.0

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
