"""What is timed is what it says: gradients of everything, and a step that changes nothing."""

from __future__ import annotations

import itertools
import math
from typing import Any

import pytest
import torch

from gsdmsr_cli.benchmark import workloads
from gsdmsr_cli.benchmark.cloud import camera, cloud
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.raster import best_engine


def test_the_cloud_is_in_the_picture_and_the_same_every_time() -> None:
    splats = cloud(500)
    assert all(map(torch.equal, splats.tensors().values(), cloud(500).tensors().values()))
    assert float(splats.means.norm(dim=1).max()) <= 1 + 1e-6
    frame = best_engine("cpu").rasterize(Moment(splats), camera(64), torch.ones(3))
    assert float((frame.radii > 0).float().mean()) > 0.95
    assert 0.2 < float(frame.alpha.mean()) < 0.9


def test_the_cloud_is_made_as_it_says() -> None:
    """Half of the splats are nearly opaque; colours are colours; sizes fall with the cube root."""
    splats, more = cloud(4000), cloud(32_000)
    opacities = splats.logit_opacities.sigmoid()
    assert float((opacities > 0.8).float().mean()) == pytest.approx(0.5, abs=0.03)
    assert float(opacities.min()) > 0.02 and float(opacities.max()) < 0.9951
    colours = 0.5 + SH_C0 * splats.sh[:, 0]
    assert 0 <= float(colours.min()) < 0.01 and 0.99 < float(colours.max()) <= 1
    shrunk = more.log_scales.mean() - splats.log_scales.mean()
    assert float(shrunk) == pytest.approx(-math.log(2), abs=0.03)
    # the 30 % that lie anywhere fill a ball of 0.9 evenly: within half of it there is an eighth
    radii = splats.means.norm(dim=1)
    assert float((radii > 0.9).float().mean()) < 0.1
    assert float((radii > 0.999).float().mean()) < 0.05


def test_drawing_takes_the_gradients_of_all_that_is_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Moment] = []
    engine = best_engine("cpu")

    class Watched:
        def rasterize(self, moment: Moment, *rest: Any) -> Any:
            drawn.append(moment)
            for tensor in moment.tensors().values():
                tensor.retain_grad()
                tensor.register_hook(lambda gradient: lengths.append(float(gradient.norm())))
            return engine.rasterize(moment, *rest)

    lengths: list[float] = []
    monkeypatch.setattr(workloads, "best_engine", lambda device: Watched())
    run = workloads.drawing(32, 200)
    run()
    assert len(lengths) == 5 and min(lengths) > 0
    assert all(tensor.grad is None for tensor in drawn[0].tensors().values())


@pytest.mark.parametrize("motion", ["hexplane", "multiscale", "control_points"])
def test_a_step_takes_all_gradients_and_moves_nothing(
    motion: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Any] = []
    true = workloads.compare

    def remember(engine: Any, model: Any, *rest: Any) -> Any:
        outcome = true(engine, model, *rest)
        seen.append((model, {n: t.detach().clone() for n, t in model.tensors().items()}, outcome))
        return outcome

    monkeypatch.setattr(workloads, "compare", remember)
    run = workloads.training_step(32, 200, motion)
    run()
    run()
    model, before, look = seen[0]
    assert look.loss > 0 and look.on_screen.shape == (200, 2)
    for (name, tensor), gradient in zip(model.tensors().items(), look.gradients, strict=True):
        assert gradient is not None and gradient.isfinite().all(), name
        assert torch.equal(tensor, before[name]), name
        assert tensor.grad is None
    assert seen[1][2].loss == look.loss


def test_following_goes_on_from_where_splats_and_control_points_were(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    true, seen = workloads.skin.skin, []

    def remember(splats: Any, points: Any, *rest: Any) -> Any:
        moved = true(splats, points, *rest)
        for tensor in (splats.means, splats.quats, points, *rest[:2]):
            tensor.register_hook(lambda gradient: lengths.append(float(gradient.norm())))
        seen.append((splats.means.detach().clone(), points.detach().clone(), rest[2]))
        return moved

    lengths: list[float] = []
    monkeypatch.setattr(workloads.skin, "skin", remember)
    run = workloads.following(2000)
    for _ in range(workloads.MOVES + 1):
        run()
    assert len(lengths) >= 5 * len(seen) and min(lengths) > 0
    for before, after in itertools.pairwise(seen[: workloads.MOVES]):
        for one, other in zip(before[:2], after[:2], strict=True):
            assert 0.5 < float((other - one).std()) / workloads.MOVE < 1.5
    assert all(map(torch.equal, seen[0], seen[-1]))


def test_a_target_has_a_loss_at_nearly_every_pixel() -> None:
    rgb = torch.full((20, 30, 3), 0.5)
    target = workloads.target_of(rgb)
    assert (target.dtype, target.shape) == (torch.uint8, (3, 20, 30))
    assert float((target != 127).float().mean()) > 0.9
