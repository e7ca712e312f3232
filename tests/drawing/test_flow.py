"""Optical flow of splats: against closed forms, float64 sums, and pictures that really move."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gsdmsr_cli.drawing.flow import draw_flow, project
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.raster import load_engine
from gsdmsr_cli.scene.camera import Camera, look_at

CAMERA = Camera(np.eye(4), 40.0, 50.0, 24.0, 20.0, 48, 40)
ENGINES = ("reference", "cpu")


def moment_at(means: list[list[float]], opacity: float = 0.9, size: float = 0.2) -> Moment:
    count = len(means)
    splats = Splats(
        means=torch.tensor(means),
        quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
        log_scales=torch.full((count, 3), math.log(size)),
        logit_opacities=torch.full((count,), math.log(opacity / (1 - opacity))),
        sh=torch.randn(count, 4, 3, generator=torch.Generator().manual_seed(1)),
    )
    return Moment(splats)


@pytest.mark.parametrize("name", ENGINES)
@pytest.mark.parametrize("step", [(0.3, 0.0, 0.0), (-0.1, 0.25, 0.0), (0.0, 0.0, 1.0)])
def test_one_splat_moves_as_its_centre_does(name: str, step: tuple[float, ...]) -> None:
    x, y, z = 0.2, -0.1, 3.0
    now, later = moment_at([[x, y, z]]), moment_at([[x + step[0], y + step[1], z + step[2]]])
    flow = draw_flow(now, CAMERA, later, CAMERA, load_engine(name)).numpy()
    there = z + step[2]
    expected = (
        40 * ((x + step[0]) / there - x / z),
        50 * ((y + step[1]) / there - y / z),
    )
    seen = np.abs(flow).sum(2) > 0
    assert 20 < seen.sum() < 0.5 * seen.size
    np.testing.assert_allclose(flow[seen], np.broadcast_to(expected, flow[seen].shape), atol=1e-4)


@pytest.mark.parametrize("name", ENGINES)
def test_a_camera_that_moves_makes_things_flow_the_other_way(name: str) -> None:
    moment = moment_at([[0.0, 0.0, 3.0]])
    pose = np.eye(4)
    pose[0, 3] = -0.3  # the camera goes to the right
    moved = Camera(pose, 40.0, 50.0, 24.0, 20.0, 48, 40)
    flow = draw_flow(moment, CAMERA, moment, moved, load_engine(name))
    assert flow[20, 24].tolist() == pytest.approx([-4.0, 0.0], abs=1e-4)
    still = draw_flow(moment, CAMERA, moment, CAMERA, load_engine(name))
    assert still.abs().max() < 1e-6


@pytest.mark.parametrize("name", ENGINES)
def test_splats_that_overlap_are_blended_as_their_colours_are(name: str) -> None:
    """Front and back splat, weights a and b (1 - a), by hand in float64."""
    now = moment_at([[0.0, 0.0, 2.0], [0.1, 0.0, 4.0]], opacity=0.5, size=0.4)
    later = moment_at([[0.2, 0.1, 2.0], [-0.1, 0.3, 4.0]], opacity=0.5, size=0.4)
    flow = draw_flow(now, CAMERA, later, CAMERA, load_engine(name)).double().numpy()
    means = now.splats.means.double().numpy()
    steps = later.splats.means.double().numpy() - means
    rows, columns = np.mgrid[0:40, 0:48] + 0.5
    weights = []
    for x, y, z in means:
        jacobian = np.array([[40 / z, 0, -40 * x / z**2], [0, 50 / z, -50 * y / z**2]])
        conic = np.linalg.inv(0.4**2 * jacobian @ jacobian.T + 0.3 * np.eye(2))
        offset = np.stack([columns - (40 * x / z + 24), rows - (50 * y / z + 20)], -1)
        weights.append(0.5 * np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", offset, conic, offset)))
    front, back = weights[0], weights[1] * (1 - weights[0])
    moved = steps[:, :2] * [40, 50] / means[:, 2:]
    expected = (front[..., None] * moved[0] + back[..., None] * moved[1]) / (front + back)[
        ..., None
    ]
    sure = (weights[0] > 0.02) & (weights[1] > 0.02)
    assert sure.sum() > 100
    np.testing.assert_allclose(flow[sure], expected[sure], atol=2e-3)


def test_the_flow_carries_one_picture_onto_the_next() -> None:
    """A cloud is drawn twice; the first picture, looked up along the flow, is the second."""
    rng = np.random.default_rng(5)
    grid = np.stack(np.meshgrid(*[np.linspace(-0.8, 0.8, 13)] * 2), -1).reshape(-1, 2)
    means = np.column_stack([grid, rng.uniform(2.9, 3.1, len(grid))]).astype(np.float32)
    now = moment_at(means.tolist(), size=0.09)
    pose = np.eye(4)
    pose[:3, 3] = [-0.2, 0.07, 0.05]
    after = Camera(pose, 40.0, 50.0, 24.0, 20.0, 48, 40)
    engine = load_engine("cpu")
    flow = draw_flow(now, CAMERA, now, after, engine).numpy()
    first = engine.rasterize(now, CAMERA, torch.zeros(3), 0).rgb.numpy()
    second = engine.rasterize(now, after, torch.zeros(3), 0).rgb.numpy()
    assert np.abs(flow).max() > 2
    rows, columns = np.mgrid[14:26, 17:31]
    x, y = columns + flow[rows, columns, 0], rows + flow[rows, columns, 1]
    carried = bilinear(second, x, y)
    error = np.abs(carried - first[rows, columns]).mean()
    unmoved = np.abs(second[rows, columns] - first[rows, columns]).mean()
    assert error < 0.25 * unmoved


def bilinear(picture: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    i, j = np.floor(y).astype(int), np.floor(x).astype(int)
    v, u = (y - i)[..., None], (x - j)[..., None]
    upper = (1 - u) * picture[i, j] + u * picture[i, j + 1]
    lower = (1 - u) * picture[i + 1, j] + u * picture[i + 1, j + 1]
    return (1 - v) * upper + v * lower


def test_what_goes_behind_the_camera_has_a_finite_flow() -> None:
    now = moment_at([[0.1, 0.0, 2.0]])
    later = moment_at([[0.1, 0.0, -2.0]])
    later.splats.means[0, 1] = math.nan
    flow = draw_flow(now, CAMERA, later, CAMERA, load_engine("cpu"))
    assert torch.isfinite(flow).all() and flow.abs().max() <= 48 + 40


def test_no_splats_have_no_flow() -> None:
    empty = moment_at([[0.0, 0.0, 2.0]]).take(torch.zeros(0, dtype=torch.int64))
    flow = draw_flow(empty, CAMERA, empty, CAMERA, load_engine("cpu"))
    assert flow.shape == (40, 48, 2) and not flow.any()


def test_projection_is_the_engines() -> None:
    moment = moment_at([[0.2, -0.1, 3.0], [0.5, 0.4, 2.0]])
    pose = look_at(np.array([0.3, 0.2, -1.0]), np.array([0.0, 0, 3]), np.array([0.1, -1.0, 0]))
    camera = Camera(pose, 40.0, 50.0, 24.0, 20.0, 48, 40)
    frame = load_engine("reference").rasterize(moment, camera, torch.zeros(3))
    torch.testing.assert_close(
        project(moment.splats.means, camera), frame.means2d, rtol=1e-5, atol=1e-4
    )
