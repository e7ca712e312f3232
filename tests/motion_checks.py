"""Small motions and splats for tests, and how a motion is made to move."""

from __future__ import annotations

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any, cast

import torch
from kernel_checks import generator
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model import motion as motions
from gsdmsr_cli.model.layer import Facts, Instant, Layer, start_layer
from gsdmsr_cli.model.model import MOTION, Model
from gsdmsr_cli.options.preset import DensityOptions
from gsdmsr_cli.training.population import Tick
from gsdmsr_cli.training.population.density import Density
from gsdmsr_cli.training.resizing import resize_model
from gsdmsr_cli.training.standing import let_stand_still
from gsdmsr_cli.training.statistics import DensityStatistics

FACTS = Facts(bound=1.3, box=((-1.3, -1.2, -1.1), (1.3, 1.4, 1.0)), frames=20)


def splats_of(count: int, seed: int = 0) -> Splats:
    """Return splats whose means fill the box of ``FACTS``."""
    rng = generator(seed)
    return Splats(
        means=(torch.rand(count, 3, generator=rng) * 2 - 1) * FACTS.bound,
        quats=torch.randn(count, 4, generator=rng),
        log_scales=torch.randn(count, 3, generator=rng) - 3,
        logit_opacities=torch.randn(count, generator=rng),
        sh=torch.randn(count, 4, 3, generator=rng),
    )


def start_motion(settings: Mapping[str, Any], facts: Facts, count: int) -> Layer:
    """Return a motion as training starts it with so many splats."""
    return start_layer(motions.__name__, settings, facts, splats_of(count), generator())


def started(name: str, count: int = 1, /, **options: Any) -> Layer:
    """Return the motion as training starts it with so many splats, in a scene of ``FACTS``."""
    return start_motion({"name": name, **options}, FACTS, count)


def disturbed(motion: Layer) -> Layer:
    """Return the motion in its last phase, with all that is trained moved away from its start."""
    motion.advance(1.0)
    rng = generator(1)
    with torch.no_grad():
        for tensor in (p.tensor for p in motion.parameters() if p.rate is not None):
            tensor += 0.1 * torch.randn(tensor.shape, generator=rng)
    return motion


def moved_by(layer: Layer, splats: Splats, time: float) -> Splats:
    """Return the splats as a layer by itself says that they are at a time."""
    return layer.at(Moment(splats), Instant(time)).splats


def penalty_of(layer: Layer, splats: Splats, time: float, source: torch.Generator) -> Tensor | None:
    """Return the regularisers of a layer that is given these splats."""
    return layer.penalty(Moment(splats), Instant(time), source)


def model_of(
    splats: Splats, motion: Layer, moving: int | None = None, precision: str = "float32"
) -> Model:
    """Return the model of a motion and no further layers."""
    return Model(splats, {MOTION: motion}, moving, precision)


def splats_at(model: Model, time: float, gradient_mask: Tensor | None = None) -> Splats:
    """Return what is drawn of a model at a time."""
    return model.at(model.instant(time), gradient_mask).splats


def stand_still(model: Model, still: Tensor, where: Splats) -> list[int]:
    """Let splats stand still and return the row that each of the new rows was."""
    rows, fresh = resize_model(model, let_stand_still(model, still, where))
    assert not fresh.any()
    return rows.tolist()


def are_among(points: Tensor, others: Tensor) -> bool:
    """Tell whether every point (N, 3) is one of the others, to the last bit."""
    return set(map(tuple, points.tolist())) <= set(map(tuple, others.tolist()))


def pruned_to(model: Model) -> list[int]:
    """Return the rows that density control keeps, where no splat is to grow."""
    count = len(model.splats)
    population = SimpleNamespace(
        model=model, statistics=DensityStatistics(count), radius=100.0, generator=generator()
    )
    control = Density(DensityOptions())
    return control.apply(cast(Any, population), Tick(1000, 0.9)).rows.tolist()
