"""Pictures of the outputs: closed forms for a flat scene, and colours that do not flicker."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from motion_checks import model_of

from gsdmsr_cli.evaluation.protocol import ViewRenderer
from gsdmsr_cli.filming.buffers import BufferRenderer, Buffers
from gsdmsr_cli.filming.outputs import FULL_ERROR, ColourRange, find_colour_range, numbers, picture
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Instant, Layer
from gsdmsr_cli.raster import load_engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.film import Shot
from gsdmsr_cli.scene.imaging import colour_wheel, turbo
from gsdmsr_cli.scene.pictures import Pictures

CAMERA = Camera(np.eye(4), 40.0, 40.0, 24.0, 20.0, 48, 40)


class Wall(Layer):
    """Moves all splats to the right by ``speed`` in time, and remembers which times were asked."""

    def __init__(self, speed: float = 0.0, depth: float = 2.0) -> None:
        super().__init__()
        self.asked: list[float] = []
        self.speed, self.depth = speed, depth

    def at(self, moment: Moment, instant: Instant) -> Moment:
        self.asked.append(instant.time)
        way = torch.tensor([self.speed * instant.time, 0.0, 0.0])
        return Moment(replace(moment.splats, means=moment.splats.means + way))

    def splats(self) -> Splats:
        """Return a wall of splats at ``depth``."""
        grid = torch.stack(torch.meshgrid(*[torch.linspace(-2, 2, 41)] * 2, indexing="ij"), -1)
        count = grid.shape[0] * grid.shape[1]
        return Splats(
            means=torch.cat([grid.reshape(-1, 2), torch.full((count, 1), self.depth)], 1),
            quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
            log_scales=torch.tensor([0.1, 0.1, 1e-3]).log().repeat(count, 1),
            logit_opacities=torch.full((count,), 3.0),
            sh=torch.zeros(count, 1, 3),
        )


def renderer_of(wall: Wall) -> ViewRenderer:
    model, pictures = model_of(wall.splats(), wall), Pictures((1.0, 1.0, 1.0), 1, 0)
    return ViewRenderer(model, load_engine("cpu"), pictures, torch.ones(3))


def test_a_wall_has_its_depth_and_its_flow_everywhere() -> None:
    buffer_renderer = BufferRenderer(renderer_of(Wall(speed=0.5)), 1, {"depth", "flow"})
    buffers = buffer_renderer.draw(Shot(CAMERA, 0.0), Shot(CAMERA, 0.2))
    np.testing.assert_allclose(numbers("depth", buffers)[..., 0], 2.0, rtol=1e-5)
    np.testing.assert_allclose(numbers("flow", buffers)[..., 0], 40 * 0.1 / 2, atol=1e-4)
    np.testing.assert_allclose(numbers("flow", buffers)[..., 1], 0, atol=1e-4)
    np.testing.assert_allclose(buffers.rgb, 0.5, atol=1e-3)


@pytest.mark.parametrize("factor", [2, 3])
def test_supersampled_layers_mean_the_same(factor: int) -> None:
    buffer_renderer = BufferRenderer(renderer_of(Wall(speed=0.5)), factor, {"depth", "flow"})
    drawn = buffer_renderer.draw(Shot(CAMERA, 0.0), Shot(CAMERA, 0.2))
    assert drawn.rgb.shape == (40 * factor, 48 * factor, 3)
    buffers = drawn.shrunk(factor)
    assert buffers.rgb.shape == (40, 48, 3) and buffers.alpha.shape == (40, 48)
    np.testing.assert_allclose(buffers.expected_depth, 2.0, rtol=1e-5)
    assert buffers.flow is not None
    np.testing.assert_allclose(buffers.flow[..., 0], 2.0, atol=1e-4)


def test_shrinking_takes_the_mean_of_blocks() -> None:
    rng = np.random.default_rng(0)
    rgb, alpha = rng.random((6, 8, 3), np.float32), rng.random((6, 8), np.float32)
    buffers = Buffers(rgb, alpha).shrunk(2)
    np.testing.assert_allclose(buffers.rgb, rgb.reshape(3, 2, 4, 2, 3).mean((1, 3)), atol=1e-6)
    np.testing.assert_allclose(buffers.alpha, alpha.reshape(3, 2, 4, 2).mean((1, 3)), atol=1e-6)


def test_each_moment_is_moved_to_once() -> None:
    wall = Wall(speed=1.0)
    buffer_renderer = BufferRenderer(renderer_of(wall), 1, {"rgb", "flow"})
    shots = [Shot(CAMERA, t) for t in (0.0, 0.25, 0.5)]
    for shot, following in zip(shots, [*shots[1:], None], strict=True):
        buffer_renderer.draw(shot, following)
    assert wall.asked == [0.0, 0.25, 0.5]


def test_what_is_not_asked_for_is_not_drawn() -> None:
    buffers = BufferRenderer(renderer_of(Wall()), 1, {"rgb"}).draw(
        Shot(CAMERA, 0.0), Shot(CAMERA, 1.0)
    )
    assert buffers.depth is None and buffers.flow is None


def uniform_buffers(alpha: float, depth: float, flow: tuple[float, float] = (0, 0)) -> Buffers:
    shape = (4, 5)
    return Buffers(
        rgb=np.full((*shape, 3), 0.3, np.float32),
        alpha=np.full(shape, alpha, np.float32),
        depth=np.full(shape, alpha * depth, np.float32),
        flow=np.broadcast_to(np.array(flow, np.float32), (*shape, 2)),
    )


def test_depth_is_infinite_where_nothing_is_seen() -> None:
    buffers = uniform_buffers(0.0, 3.0)
    assert np.isinf(numbers("depth", buffers)).all()
    assert not picture("depth", buffers, ColourRange(1, 5), None).any()


@pytest.mark.parametrize(("depth", "place"), [(1, 1.0), (2, 0.75), (5, 0.0), (9, 0.0), (0.5, 1.0)])
def test_near_is_warm_and_far_is_cold(depth: float, place: float) -> None:
    found = picture("depth", uniform_buffers(1.0, depth), ColourRange(1, 5), None)
    expected = turbo(np.full((4, 5), place, np.float32))
    assert np.abs(found.astype(int) - expected).max() <= 3  # the next of 256 colours, at most


def test_depth_fades_where_little_is_seen() -> None:
    full, half = (
        picture("depth", uniform_buffers(a, 2), ColourRange(1, 5), None) for a in (1.0, 0.5)
    )
    assert np.abs(full / 2 - half).max() <= 1


def test_alpha_is_grey_and_rgb_is_rounded() -> None:
    buffers = uniform_buffers(0.5, 2)
    assert (picture("alpha", buffers, ColourRange(), None) == 128).all()
    assert picture("alpha", buffers, ColourRange(), None).shape == (4, 5, 1)
    assert (
        picture("rgb", buffers, ColourRange(), None) == 76
    ).all()  # 76.5 goes to the even neighbour


def test_flow_is_coloured_by_its_share_of_the_fastest() -> None:
    buffers = uniform_buffers(1.0, 2, flow=(0, 1.5))
    found = picture("flow", buffers, ColourRange(fast=0.6), None)  # 0.6 of 5 px are 3 px
    expected = colour_wheel(np.broadcast_to(np.array([0, 0.5], np.float32), (4, 5, 2)))
    np.testing.assert_array_equal(found, expected)


def test_the_error_is_the_mean_difference_of_what_is_written() -> None:
    buffers = uniform_buffers(1.0, 2)
    true = np.full((4, 5, 3), 76 / 255, np.float32)
    nothing = picture("error", buffers, ColourRange(), true)
    np.testing.assert_array_equal(nothing, turbo(np.zeros((4, 5), np.float32)))
    true[..., 0] += 0.5 * 3 * FULL_ERROR
    half = picture("error", buffers, ColourRange(), true)
    expected = turbo(np.full((4, 5), 0.5, np.float32))
    assert np.abs(half.astype(int) - expected).max() <= 6


def test_the_ends_are_those_of_the_whole_film() -> None:
    shots = [Shot(CAMERA, t) for t in np.linspace(0, 1, 30)]
    colours = find_colour_range(renderer_of(Wall(speed=2.9)), shots, ("rgb", "depth", "flow"))
    assert colours.near == pytest.approx(2, rel=1e-4) and colours.far > colours.near
    assert colours.fast * 48 == pytest.approx(40 * 2.9 / 29 / 2, rel=0.02)
    assert find_colour_range(renderer_of(Wall()), shots, ("rgb", "alpha")) == ColourRange()


def test_a_film_of_nothing_has_ends_too() -> None:
    behind = renderer_of(Wall(depth=-3.0))
    colours = find_colour_range(behind, [Shot(CAMERA, 0.0), Shot(CAMERA, 1.0)], ("depth", "flow"))
    assert (colours.near, colours.far, colours.fast) == (0.0, 1.0, 1.0)
    assert colours.document("depth") == {"near": 0.0, "far": 1.0}
    assert colours.document("flow") == {"fast": 1.0} and colours.document("rgb") == {}
