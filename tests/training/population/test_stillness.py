"""How much splats move, worked out by hand."""

from __future__ import annotations

import math
import weakref
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from motion_checks import disturbed, splats_of, stand_still, started
from motion_checks import model_of as model_of_motion
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Instant, Layer
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.training.population.stillness import motion_saliency
from gsdmsr_cli.training.standing import MOMENTS

At = Callable[[Splats, float], Splats]


class Known(Layer):
    """A motion of one's own making."""

    def __init__(self, at: At) -> None:
        super().__init__()
        self._at = at

    def at(self, moment: Moment, instant: Instant) -> Moment:
        return replace(moment, splats=self._at(moment.splats, instant.time))


def model_of(splats: Splats, at: At) -> Model:
    return model_of_motion(splats, Known(at))


def still_splats(count: int = 3) -> Splats:
    return replace(splats_of(count), log_scales=torch.full((count, 3), math.log(0.02)))


def test_what_stands_still_has_none() -> None:
    splats = splats_of(6)
    saliency, mean = motion_saliency(model_of(splats, lambda s, _: s))
    torch.testing.assert_close(saliency, torch.zeros(6), atol=1e-5, rtol=0)
    for name, tensor in mean.tensors().items():
        torch.testing.assert_close(tensor, splats.tensors()[name], atol=1e-6, rtol=1e-6)


def test_a_way_counts_in_units_of_the_own_size() -> None:
    """From -1 to 1 times (0.03, 0.04, 0): at the ends 0.05 from the mean, 2.5 scales of 0.02."""
    way = torch.tensor([[0.03, 0.04, 0.0], [0.0, 0.0, 0.0], [0.0, 0.003, 0.004]])

    def at(splats: Splats, time: float) -> Splats:
        return replace(splats, means=splats.means + (2 * time - 1) * way)

    saliency, mean = motion_saliency(model_of(still_splats(), at))
    torch.testing.assert_close(saliency, torch.tensor([2.5, 0, 0.25]), atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(mean.means, still_splats().means, atol=1e-6, rtol=0)


class Rising(Layer):
    """Lets all splats rise, those that stand still as well."""

    concerns_still = True

    def at(self, moment: Moment, instant: Instant) -> Moment:
        way = torch.tensor([0.0, 0.0, 1.0]) * (1 + instant.time)
        return replace(moment, splats=replace(moment.splats, means=moment.splats.means + way))


def test_what_layers_do_to_still_splats_too_neither_counts_nor_is_done_twice() -> None:
    splats = still_splats()
    layers: dict[str, Layer] = {"motion": Known(lambda s, _: s), "layers.rising": Rising()}
    model = Model(splats, layers)
    drawn = model.at(model.instant(0.5)).splats.means.detach().clone()
    saliency, mean = motion_saliency(model)
    torch.testing.assert_close(saliency, torch.zeros(3), atol=1e-4, rtol=0)
    stand_still(model, saliency < 1, mean)
    assert model.moving == 0
    torch.testing.assert_close(model.at(model.instant(0.5)).splats.means, drawn)


def test_an_offset_for_all_times_is_no_motion() -> None:
    def at(splats: Splats, time: float) -> Splats:
        return replace(splats, means=splats.means + 3)

    saliency, mean = motion_saliency(model_of(still_splats(), at))
    assert float(saliency.max()) < 1e-3
    torch.testing.assert_close(mean.means, still_splats().means + 3)


def test_growing_counts_as_the_logarithm() -> None:
    def at(splats: Splats, time: float) -> Splats:
        growth = torch.tensor([0.0, 0.4, 0.0]) * (2 * time - 1)
        return replace(splats, log_scales=splats.log_scales + growth)

    saliency, _ = motion_saliency(model_of(still_splats(), at))
    torch.testing.assert_close(saliency, torch.full((3,), 0.4), atol=1e-5, rtol=0)


def test_turning_counts_as_the_angle() -> None:
    """From -0.3 to 0.3 about z; quaternions of any length and sign."""

    def at(splats: Splats, time: float) -> Splats:
        half = 0.3 * (2 * time - 1) / 2
        turn = torch.tensor([math.cos(half), 0.0, 0.0, math.sin(half)])
        return replace(splats, quats=turn * torch.tensor([[1.0], [7.0], [-2.0]]))

    saliency, _ = motion_saliency(model_of(still_splats(), at))
    torch.testing.assert_close(saliency, torch.full((3,), 0.3), atol=1e-4, rtol=0)


@pytest.mark.parametrize("name", ["logit_opacities", "sh"])
def test_whatever_else_a_motion_changes_counts_too(name: str) -> None:
    def at(splats: Splats, time: float) -> Splats:
        return replace(splats, **{name: splats.tensors()[name] + time})

    saliency, _ = motion_saliency(model_of(still_splats(), at))
    assert float(saliency.min()) > 0.1


def test_moments_are_not_all_in_memory_at_once() -> None:
    """16 copies of a million splats are 3 GB."""
    alive: weakref.WeakSet[Tensor] = weakref.WeakSet()
    most = 0

    def at(splats: Splats, time: float) -> Splats:
        nonlocal most
        moved = splats.means + time
        alive.add(moved)
        most = max(most, len(alive))
        return replace(splats, means=moved)

    motion_saliency(model_of(splats_of(4), at))
    assert 1 <= most <= 3  # the first, the present and the one after it


@torch.no_grad()
def test_the_mean_is_that_of_all_moments_and_what_stays_keeps_its_bits() -> None:
    splats = splats_of(50)
    model = Model(splats, {"motion": disturbed(started("multiscale", 50))})
    times = [model.instant(i / (MOMENTS - 1)) for i in range(MOMENTS)]
    moments = [model.at(time).splats.tensors() for time in times]
    _, mean = motion_saliency(model)
    for name, tensor in mean.tensors().items():
        exact = torch.stack([moment[name] for moment in moments]).double().mean(dim=0)
        torch.testing.assert_close(tensor.double(), exact, atol=1e-6, rtol=1e-6, msg=name)
    for name in ("sh", "logit_opacities"):
        assert torch.equal(mean.tensors()[name], splats.tensors()[name]), name


def test_who_stands_still_already_has_none() -> None:
    model = model_of_motion(splats_of(5), disturbed(started("multiscale", 5)))
    saliency, mean = motion_saliency(model)
    still = saliency <= saliency.median()
    order = stand_still(model, still, mean)
    again, _ = motion_saliency(model)
    assert float(again[model.moving :].max()) < 1e-5
    kept = order[: model.moving]
    torch.testing.assert_close(again[: model.moving], saliency[kept])
