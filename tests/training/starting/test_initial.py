"""The splats a training starts from, of scenes with and without points."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from kernel_checks import generator

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.options.preset import SplatOptions
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training.starting.initial import initial_splats

BOUND = 1.5


def scene_of(points: np.ndarray | None = None, bound: float = BOUND) -> Scene:
    points = np.zeros((0, 3), np.float32) if points is None else points.astype(np.float32)
    colours = np.random.default_rng(0).random(points.shape, np.float32)
    return Scene(Path(), "test", (), points, colours, None, bound, "")


def start(scene: Scene, seed: int = 0, most: int = 10_000, **options: Any) -> Splats:
    """Return the splats of a scene without pictures, of which no time is known."""
    chosen = SplatOptions(**{"start": "box", **options})
    pictures = Pictures((1.0, 1.0, 1.0), 1, 0)
    given = chosen, pictures, torch.ones(3), generator(seed), most
    splats, times = initial_splats(scene, *given)
    assert times.shape == (len(splats),) and times.isnan().all()
    return splats


def grid_of(step: float, offset: float = 0.0) -> np.ndarray:
    axis = np.arange(4) * step + offset
    return np.stack(np.meshgrid(axis, axis, axis), -1).reshape(-1, 3)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_the_box_is_filled_at_random_where_there_are_no_points(degree: int) -> None:
    splats = start(scene_of(), count=3000, opacity=0.2, sh_degree=degree)
    assert len(splats) == 3000 and splats.sh_degree == degree
    assert splats.means.abs().max() <= BOUND
    # uniform in the box: mean 0, variance (2 bound)^2 / 12
    assert splats.means.mean(dim=0).abs().max() < 0.1
    torch.testing.assert_close(
        splats.means.var(dim=0), torch.full((3,), BOUND**2 / 3), atol=0.05, rtol=0
    )
    assert torch.sigmoid(splats.logit_opacities).numpy() == pytest.approx(0.2)
    assert torch.equal(splats.quats, torch.tensor([[1.0, 0, 0, 0]]).expand(3000, 4))
    assert (SH_C0 * splats.sh[:, 0]).abs().max() < 2 / 255
    assert not splats.sh[:, 1:].any()
    assert all(t.dtype == torch.float32 for t in splats.tensors().values())


def test_the_seed_decides() -> None:
    one, same, other = (start(scene_of(), seed, count=50) for seed in (3, 3, 4))
    assert torch.equal(one.means, same.means) and not torch.equal(one.means, other.means)


def test_points_of_the_scene_are_used_as_they_are() -> None:
    scene = scene_of(grid_of(0.3))
    splats = start(scene, count=7, sh_degree=2)
    assert torch.equal(splats.means, torch.from_numpy(scene.points))
    colours = (0.5 + SH_C0 * splats.sh[:, 0]).numpy()
    np.testing.assert_allclose(colours, scene.colours, atol=1e-6)


@pytest.mark.parametrize("offset", [0.0, 1.0, 100.0])
def test_scales_are_the_distance_to_the_nearest(offset: float) -> None:
    """Every point of a cubic grid has three neighbours one step away, wherever the grid lies."""
    splats = start(scene_of(grid_of(0.01, offset)))
    assert splats.log_scales.exp().numpy() == pytest.approx(0.01, rel=2e-2)


def test_scales_average_squares_of_three_distances() -> None:
    line = np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [7, 0, 0], [100, 0, 0]])
    splats = start(scene_of(line))
    expected = math.sqrt((1 + 3**2 + 7**2) / 3)
    assert splats.log_scales[0].exp().tolist() == pytest.approx([expected] * 3)


def test_few_or_coincident_points_have_finite_scales() -> None:
    alone = start(scene_of(np.ones((1, 3))))
    assert alone.log_scales.exp().tolist()[0] == pytest.approx([0.1 * BOUND] * 3)
    pair = start(scene_of(np.eye(3)[:2]))
    assert pair.log_scales.exp().numpy() == pytest.approx(math.sqrt(2))
    same = start(scene_of(np.ones((9, 3))))
    assert same.log_scales.isfinite().all()


def test_there_are_never_more_than_the_cap() -> None:
    points = np.random.default_rng(1).random((500, 3), np.float32)
    scene = scene_of(points)
    splats = start(scene, most=60)
    # some of the points, each with its own colour, in their order and from all of them
    rows = [int(np.flatnonzero((points == mean).all(axis=1))[0]) for mean in splats.means.numpy()]
    assert len(rows) == 60 and rows == sorted(set(rows)) and rows[0] < 100 and rows[-1] > 400
    assert scene.colours is not None
    np.testing.assert_allclose(0.5 + SH_C0 * splats.sh[:, 0], scene.colours[rows], atol=1e-6)
    assert len(start(scene, most=500)) == 500
    assert len(start(scene_of(), most=60, count=100)) == 60
