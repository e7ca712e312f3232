"""What is made of the layers: closed forms for a flat scene, and colours that do not flicker."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from gsdmsr_cli.camera import Camera
from gsdmsr_cli.evaluation.protocol import Studio
from gsdmsr_cli.film import Shot
from gsdmsr_cli.filming.layers import Artist, Layers
from gsdmsr_cli.filming.outputs import FULL_ERROR, Ends, find_ends, numbers, picture
from gsdmsr_cli.imaging import colour_wheel, turbo
from gsdmsr_cli.raster import load_engine
from gsdmsr_cli.splats import Splats

CAMERA = Camera(np.eye(4), 40.0, 40.0, 24.0, 20.0, 48, 40)


class Wall:
    """A wall of splats at depth 2 that moves to the right by ``speed`` in time, and its model."""

    def __init__(self, speed: float = 0.0, depth: float = 2.0) -> None:
        self.asked: list[float] = []
        self.speed, self.depth = speed, depth

    def at(self, time: float) -> Splats:
        self.asked.append(time)
        grid = torch.stack(torch.meshgrid(*[torch.linspace(-2, 2, 41)] * 2, indexing="ij"), -1)
        flat = grid.reshape(-1, 2) + torch.tensor([self.speed * time, 0.0])
        count = len(flat)
        return Splats(
            means=torch.cat([flat, torch.full((count, 1), self.depth)], 1),
            quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
            log_scales=torch.tensor([0.1, 0.1, 1e-3]).log().repeat(count, 1),
            logit_opacities=torch.full((count,), 3.0),
            sh=torch.zeros(count, 1, 3),
        )


def studio_of(model: Any) -> Studio:
    return Studio(model, load_engine("cpu"), SimpleNamespace(), torch.ones(3))  # type: ignore


def test_a_wall_has_its_depth_and_its_flow_everywhere() -> None:
    artist = Artist(studio_of(Wall(speed=0.5)), 1, {"depth", "flow"})
    layers = artist.draw(Shot(CAMERA, 0.0), Shot(CAMERA, 0.2))
    np.testing.assert_allclose(numbers("depth", layers)[..., 0], 2.0, rtol=1e-5)
    np.testing.assert_allclose(numbers("flow", layers)[..., 0], 40 * 0.1 / 2, atol=1e-4)
    np.testing.assert_allclose(numbers("flow", layers)[..., 1], 0, atol=1e-4)
    np.testing.assert_allclose(layers.rgb, 0.5, atol=1e-3)


@pytest.mark.parametrize("factor", [2, 3])
def test_supersampled_layers_mean_the_same(factor: int) -> None:
    artist = Artist(studio_of(Wall(speed=0.5)), factor, {"depth", "flow"})
    drawn = artist.draw(Shot(CAMERA, 0.0), Shot(CAMERA, 0.2))
    assert drawn.rgb.shape == (40 * factor, 48 * factor, 3)
    layers = drawn.shrunk(factor)
    assert layers.rgb.shape == (40, 48, 3) and layers.alpha.shape == (40, 48)
    np.testing.assert_allclose(layers.expected_depth, 2.0, rtol=1e-5)
    assert layers.flow is not None
    np.testing.assert_allclose(layers.flow[..., 0], 2.0, atol=1e-4)


def test_shrinking_takes_the_mean_of_blocks() -> None:
    rng = np.random.default_rng(0)
    rgb, alpha = rng.random((6, 8, 3), np.float32), rng.random((6, 8), np.float32)
    layers = Layers(rgb, alpha).shrunk(2)
    np.testing.assert_allclose(layers.rgb, rgb.reshape(3, 2, 4, 2, 3).mean((1, 3)), atol=1e-6)
    np.testing.assert_allclose(layers.alpha, alpha.reshape(3, 2, 4, 2).mean((1, 3)), atol=1e-6)


def test_each_moment_is_moved_to_once() -> None:
    wall = Wall(speed=1.0)
    artist = Artist(studio_of(wall), 1, {"rgb", "flow"})
    shots = [Shot(CAMERA, t) for t in (0.0, 0.25, 0.5)]
    for shot, following in zip(shots, [*shots[1:], None], strict=True):
        artist.draw(shot, following)
    assert wall.asked == [0.0, 0.25, 0.5]


def test_what_is_not_asked_for_is_not_drawn() -> None:
    layers = Artist(studio_of(Wall()), 1, {"rgb"}).draw(Shot(CAMERA, 0.0), Shot(CAMERA, 1.0))
    assert layers.depth is None and layers.flow is None


def layers_of(alpha: float, depth: float, flow: tuple[float, float] = (0, 0)) -> Layers:
    shape = (4, 5)
    return Layers(
        rgb=np.full((*shape, 3), 0.3, np.float32),
        alpha=np.full(shape, alpha, np.float32),
        depth=np.full(shape, alpha * depth, np.float32),
        flow=np.broadcast_to(np.array(flow, np.float32), (*shape, 2)),
    )


def test_depth_is_infinite_where_nothing_is_seen() -> None:
    layers = layers_of(0.0, 3.0)
    assert np.isinf(numbers("depth", layers)).all()
    assert not picture("depth", layers, Ends(1, 5), None).any()


@pytest.mark.parametrize(("depth", "place"), [(1, 1.0), (2, 0.75), (5, 0.0), (9, 0.0), (0.5, 1.0)])
def test_near_is_warm_and_far_is_cold(depth: float, place: float) -> None:
    found = picture("depth", layers_of(1.0, depth), Ends(1, 5), None)
    expected = turbo(np.full((4, 5), place, np.float32))
    assert np.abs(found.astype(int) - expected).max() <= 3  # the next of 256 colours, at most


def test_depth_fades_where_little_is_seen() -> None:
    full, half = (picture("depth", layers_of(a, 2), Ends(1, 5), None) for a in (1.0, 0.5))
    assert np.abs(full / 2 - half).max() <= 1


def test_alpha_is_grey_and_rgb_is_rounded() -> None:
    layers = layers_of(0.5, 2)
    assert (picture("alpha", layers, Ends(), None) == 128).all()
    assert picture("alpha", layers, Ends(), None).shape == (4, 5, 1)
    assert (picture("rgb", layers, Ends(), None) == 76).all()  # 76.5 goes to the even neighbour


def test_flow_is_coloured_by_its_share_of_the_fastest() -> None:
    layers = layers_of(1.0, 2, flow=(0, 1.5))
    found = picture("flow", layers, Ends(fast=0.6), None)  # 0.6 of 5 px are 3 px
    expected = colour_wheel(np.broadcast_to(np.array([0, 0.5], np.float32), (4, 5, 2)))
    np.testing.assert_array_equal(found, expected)


def test_the_error_is_the_mean_difference_of_what_is_written() -> None:
    layers = layers_of(1.0, 2)
    true = np.full((4, 5, 3), 76 / 255, np.float32)
    nothing = picture("error", layers, Ends(), true)
    np.testing.assert_array_equal(nothing, turbo(np.zeros((4, 5), np.float32)))
    true[..., 0] += 0.5 * 3 * FULL_ERROR
    half = picture("error", layers, Ends(), true)
    expected = turbo(np.full((4, 5), 0.5, np.float32))
    assert np.abs(half.astype(int) - expected).max() <= 6


def test_the_ends_are_those_of_the_whole_film() -> None:
    shots = [Shot(CAMERA, t) for t in np.linspace(0, 1, 30)]
    ends = find_ends(studio_of(Wall(speed=2.9)), shots, ("rgb", "depth", "flow"))
    assert ends.near == pytest.approx(2, rel=1e-4) and ends.far > ends.near
    assert ends.fast * 48 == pytest.approx(40 * 2.9 / 29 / 2, rel=0.02)
    assert find_ends(studio_of(Wall()), shots, ("rgb", "alpha")) == Ends()


def test_a_film_of_nothing_has_ends_too() -> None:
    behind = studio_of(Wall(depth=-3.0))
    ends = find_ends(behind, [Shot(CAMERA, 0.0), Shot(CAMERA, 1.0)], ("depth", "flow"))
    assert (ends.near, ends.far, ends.fast) == (0.0, 1.0, 1.0)
    assert ends.document("depth") == {"near": 0.0, "far": 1.0}
    assert ends.document("flow") == {"fast": 1.0} and ends.document("rgb") == {}
