"""Models of segments of time, drawn as one that holds at all times."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.fading import MOST, thin
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import together
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.model.model import Model, Share
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.segments import Segment, weights

_NAMED = re.compile(r"segments\.\d+\.")


def name_in(number: int, name: str) -> str:
    """Return under which name a tensor of a segment's model is saved with those of the others."""
    return f"segments.{number}.{name}"


def own_name(name: str) -> str:
    """Return a tensor's name in the model of its segment; others stay what they are."""
    return _NAMED.sub("", name, count=1) if _NAMED.match(name) else name


class Joined(Model):
    """The models of segments that overlap, each of which has been trained alone; for drawing.

    The picture of a time that two segments share is the mean of theirs, by their weights; so is
    what layers make of colours after drawing. Which splats there are depends on the time: row i is
    not the same one at all times.

    Attributes:
        segments: in the order of time, at most two at any time.
        models: of the segments, whose times are the segment's own.
        splats: all canonical splats of all models, one segment's after the other's.
        layers: of all models, by the number of the segment and their names, as "0.motion".
    """

    def __init__(self, segments: Sequence[Segment], models: Sequence[Model]) -> None:
        self.segments, self.models = tuple(segments), tuple(models)
        layers = {f"{i}.{key}": own for i, m in enumerate(models) for key, own in m.layers.items()}
        super().__init__(together([model.splats for model in models]), layers)
        self.moving = sum(model.moving for model in models)

    @property
    def steady(self) -> bool:
        """Whether row i is the same splat at all times."""
        return False

    def steadied(self) -> Lasting:
        """See ``Model.steadied``; as ``at_instants`` has it where two segments count."""
        return Lasting(self)

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors of all models, by ``name_in``."""
        return {
            name_in(i, name): tensor
            for i, model in enumerate(self.models)
            for name, tensor in model.tensors().items()
        }

    def to(self, device: torch.device | str) -> Joined:
        """Move everything to a device, in place, and return the model."""
        for model in self.models:
            model.to(device)
        super().to(device)
        return self

    def instant_of_view(
        self, time: float, camera: Camera, jitter: float = 0.0
    ) -> tuple[Instant, Camera]:
        """See ``Model.instant_of_view``; the camera is placed by the segment that counts most."""
        lead, within = self.lead(Instant(time))
        instant, placed = lead.instant_of_view(within.time, camera, jitter)
        return replace(instant, time=time), placed

    def placed(self, camera: Camera, time: float) -> Camera:
        """See ``Model.placed``."""
        lead, within = self.lead(Instant(time))
        return lead.placed(camera, within.time)

    def tell_views(self, views: Sequence[tuple[Camera, float]]) -> dict[str, Any]:
        """Return what each segment's layers have to say of its views, by its number."""
        told: dict[str, Any] = {}
        for i, (segment, model) in enumerate(zip(self.segments, self.models, strict=True)):
            own = [(camera, segment.within(time)) for camera, time in views if segment.holds(time)]
            if own and (found := model.tell_views(own)):
                told[f"{i}"] = found
        return told

    def at_instants(
        self, instants: Sequence[Instant], gradient_mask: Tensor | None = None
    ) -> list[Moment]:
        """Return the splats of each of the instants, for whom pictures do not do.

        Where two segments count, those of each have its share of the optical depth. A surface that
        both have is then as opaque as in one of them; single splats come out a little larger.

        Raises:
            ValueError: a gradient mask is given: these models are trained one by one.
        """
        if gradient_mask is not None:
            raise ValueError("models of segments are trained one by one")
        return [self._at(instant) for instant in instants]

    def canonical(self) -> Moment:
        """Return all canonical splats; no motion is given all of them."""
        return Moment(self.splats)

    def shares(self, instant: Instant) -> list[Share]:
        """Return the segments that count at an instant, see ``Model.shares``."""
        counting = weights(instant.time, self.segments)
        return [Share(weight, *self._in(i, instant)) for i, weight in counting.items()]

    def lead(self, instant: Instant, later: Instant | None = None) -> tuple[Model, Instant]:
        """Return the model of the segment that counts most at an instant, and its own instant.

        With a ``later`` one that is the instant that is returned, as the same model has it.
        """
        counting = weights(instant.time, self.segments)
        return self._in(max(counting, key=counting.__getitem__), later or instant)

    def _in(self, number: int, instant: Instant) -> tuple[Model, Instant]:
        """Return the model of a segment, and an instant in its own time."""
        within = self.segments[number].within(instant.time)
        return self.models[number], replace(instant, time=within)

    def _at(self, instant: Instant) -> Moment:
        shares = self.shares(instant)
        if len(shares) == 1:
            return shares[0].model.at(shares[0].instant)
        return _blend([(share.weight, share.model.at(share.instant)) for share in shares])


def _blend(shares: Sequence[tuple[float, Moment]]) -> Moment:
    """Return the rows of several moments, those of each with its share of the optical depth."""
    thinned = []
    for weight, moment in shares:
        logits = moment.splats.logit_opacities
        if weight < 1:
            logits = thin(logits, weight) if weight > 0 else torch.full_like(logits, -MOST)
        thinned.append(replace(moment.splats, logit_opacities=logits))
    further = (_beside([getattr(m, name) for _, m in shares]) for name in ("axes", "features"))
    return Moment(together(thinned), *further)


def _beside(tensors: Sequence[Tensor | None]) -> Tensor | None:
    """Return the rows of tensors that all moments have or none."""
    known = [tensor for tensor in tensors if tensor is not None]
    return torch.cat(known) if known else None


class Lasting(Model):
    """All splats of all segments at all times: those of segments that do not count are hidden.

    What layers make of colours after drawing is left out.

    Attributes:
        joined: the models of the segments.
        splats: theirs, one segment's after the other's, in the order of ``Joined``.
    """

    def __init__(self, joined: Joined) -> None:
        self.joined = joined
        super().__init__(joined.splats, {})

    def at_instants(
        self, instants: Sequence[Instant], gradient_mask: Tensor | None = None
    ) -> list[Moment]:
        """See ``Joined.at_instants``; splats of other segments stay as at these' nearest ends."""
        if gradient_mask is not None:
            raise ValueError("models of segments are trained one by one")
        return [self._at(instant) for instant in instants]

    def _at(self, instant: Instant) -> Moment:
        joined = self.joined
        counting = weights(instant.time, joined.segments)
        moments = []
        for i, (segment, model) in enumerate(zip(joined.segments, joined.models, strict=True)):
            within = replace(instant, time=segment.within(instant.time))
            moments.append((counting.get(i, 0.0), model.at(within)))
        return _blend(moments)
