"""Which splats matter to the pictures, against the Jacobian itself."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from kernel_checks import generator
from motion_checks import model_of, started
from torch import Tensor
from training_checks import STEPS, assert_same_tensors, copies, preset_of, run_of, trainer_of

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import scaled_axes
from gsdmsr_cli.raster import load_engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.training.population.thinning import most_sensitive, picture_sensitivity
from gsdmsr_cli.training.trainer import Trainer

CAMERA = Camera(np.eye(4), 16.0, 16.0, 8.0, 6.0, 16, 12)
BACKGROUND = torch.ones(3)

THIN = ("density.thin_at=[0.3, 0.6]", "density.thin_share=0.25", "density.until=0.5")


def row_of_splats() -> Splats:
    """Return five: two in sight, one faint, one behind a wide opaque one, one out of sight."""
    means = [[-0.5, 0.0, 2.0], [0.1, 0.2, 2.0], [0.5, -0.3, 2.0], [0.1, 0.2, 3.0], [0, 0, -2.0]]
    return Splats(
        means=torch.tensor(means),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(5, 1),
        log_scales=torch.tensor([-2.0, -0.8, -2.0, -3.0, -2.0])[:, None].repeat(1, 3),
        logit_opacities=torch.tensor([2.0, 20.0, -4.0, 2.0, 2.0]),
        sh=torch.randn(5, 1, 3, generator=generator()) - 1,
    )


def sensitivity_of(splats: Splats, engine: str, times: int, seed: int = 0) -> Tensor:
    model = model_of(splats, started("static"))
    shots = [(CAMERA, 0.0)] * times
    return picture_sensitivity(model, load_engine(engine), shots, BACKGROUND, generator(seed))


@pytest.mark.parametrize("engine", ["reference", "cpu"])
def test_the_estimate_is_the_trace_of_the_jacobian_squared(engine: str) -> None:
    splats = row_of_splats()

    def draw(means: Tensor, log_scales: Tensor) -> Tensor:
        moved = replace(splats, means=means, log_scales=log_scales)
        return load_engine("reference").rasterize(Moment(moved), CAMERA, BACKGROUND).rgb

    by_mean, by_scale = torch.autograd.functional.jacobian(draw, (splats.means, splats.log_scales))
    exact = (by_mean * splats.log_scales.exp()).square().sum(dim=(0, 1, 2, 4))
    exact += by_scale.square().sum(dim=(0, 1, 2, 4))
    pictures = 400
    found = sensitivity_of(splats, engine, pictures) / pictures
    torch.testing.assert_close(found, exact, rtol=0.15, atol=1e-6)
    assert exact[4] == 0 == found[4]
    assert exact[2] < 0.05 * exact[0] and exact[3] < 0.01 * exact[0]


def test_pictures_add_up_and_signs_come_from_the_generator() -> None:
    splats = row_of_splats()
    once, again = (sensitivity_of(splats, "cpu", 3) for _ in range(2))
    assert torch.equal(once, again)
    assert not torch.equal(once, sensitivity_of(splats, "cpu", 3, seed=1))
    assert all(parameter.grad is None for parameter in splats.tensors().values())


def test_the_unit_of_the_world_does_not_matter() -> None:
    splats = row_of_splats()
    larger = replace(splats, means=4 * splats.means, log_scales=splats.log_scales + math.log(4))
    found, expected = sensitivity_of(larger, "cpu", 5), sensitivity_of(splats, "cpu", 5)
    torch.testing.assert_close(found, expected, rtol=1e-3, atol=1e-5)


def stretched_splats() -> Splats:
    """Return those of ``row_of_splats`` with three scales each, turned at random."""
    splats = row_of_splats()
    quats = torch.randn(5, 4, generator=generator(1))
    return replace(splats, quats=quats, log_scales=splats.log_scales + torch.tensor([-0.7, 0, 0.5]))


@pytest.mark.parametrize("form", ["quats and scales", "axes"])
def test_steps_of_the_mean_are_along_the_axes_of_turned_stretched_splats(form: str) -> None:
    splats = stretched_splats()
    axes = scaled_axes(splats.quats, splats.log_scales)

    def draw(along: Tensor, stretch: Tensor) -> Tensor:
        """Draw with means moved by so many times the axes, and the axes stretched by e^s."""
        moved = replace(splats, means=splats.means + (axes @ along[..., None])[..., 0])
        moment = Moment(moved, axes * stretch.exp()[:, None])
        return load_engine("reference").rasterize(moment, CAMERA, BACKGROUND).rgb

    parts = torch.autograd.functional.jacobian(draw, (torch.zeros(5, 3), torch.zeros(5, 3)))
    exact = sum(part.square().sum(dim=(0, 1, 2, 4)) for part in parts)
    model: Any = model_of(splats, started("static"))
    if form == "axes":
        model = SimpleNamespace(splats=splats, instant=model.instant, shade=model.shade,
                                at=lambda instant: Moment(splats, axes))  # fmt: skip
    shots = [(CAMERA, 0.0)] * 400
    engine = load_engine("cpu")
    found = picture_sensitivity(model, engine, shots, BACKGROUND, generator()) / len(shots)
    torch.testing.assert_close(found, exact, rtol=0.15, atol=1e-6)


def test_the_least_go_and_the_rest_keep_their_order() -> None:
    scores = torch.tensor([3.0, 0.5, math.nan, 2.0, 9.0, 0.1, math.inf, 4.0])
    assert most_sensitive(scores, 0.5).tolist() == [0, 3, 4, 7]
    assert most_sensitive(scores, 0.0).tolist() == list(range(8))
    assert most_sensitive(scores, 0.99).tolist() == [4]
    assert most_sensitive(torch.zeros(4), 0.5).tolist() == [2, 3]


def losses_and_counts(trainer: Trainer, steps: int) -> list[tuple[float, int]]:
    return [(trainer.step().loss, len(trainer.model.splats)) for _ in range(steps)]


def test_a_training_is_thinned_when_it_is_told(tiny_scene: Path) -> None:
    trainer = trainer_of(tiny_scene, preset_of(*THIN))
    counts = [count for _, count in losses_and_counts(trainer, STEPS)]
    at = [STEPS * 3 // 10, STEPS * 6 // 10]  # the steps that begin there
    assert counts[at[0]] == counts[at[0] - 1] - counts[at[0] - 1] // 4
    assert counts[at[1]] == counts[at[1] - 1] - counts[at[1] - 1] // 4
    assert counts[-1] == counts[at[1]]


@pytest.mark.parametrize("stop", [9, 17, 30])
def test_a_thinned_training_is_resumed_as_if_never_interrupted(
    tiny_scene: Path, tmp_path: Path, stop: int
) -> None:
    whole, first, second = (trainer_of(tiny_scene, preset_of(*THIN)) for _ in range(3))
    expected = losses_and_counts(whole, STEPS)
    losses_and_counts(first, stop)
    run = run_of(first, tmp_path / "run")
    run.save(first.checkpoint())
    second.restore(run.load())
    assert losses_and_counts(second, STEPS - stop) == expected[stop:]
    found, end = (copies(trainer.checkpoint().tensors) for trainer in (second, whole))
    assert_same_tensors(found, end)
