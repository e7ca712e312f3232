"""The sky behind all splats: colours of directions, without seams."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from motion_checks import FACTS, splats_of
from torch import Tensor
from torch.nn.functional import normalize

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model import layers
from gsdmsr_cli.model.layer import Instant, start_layer
from gsdmsr_cli.model.layers.sky import Sky, grid_points
from gsdmsr_cli.ops.cube_map import directions
from gsdmsr_cli.scene.camera import Camera, look_at

CAMERA = Camera(
    look_at(np.array([3.0, 1.0, 0.5]), np.zeros(3), np.array([0.0, 0.0, 1.0])),
    9.0, 8.0, 4.5, 3.0, 8, 6,
)  # fmt: skip


def sky_of(resolution: int = 5, **options: object) -> Sky:
    settings = {"name": "sky", "resolution": resolution, **options}
    sky = start_layer(layers.__name__, settings, FACTS, splats_of(1), torch.Generator())
    assert isinstance(sky, Sky)
    return sky


def on_cube(ways: Tensor) -> Tensor:
    """Return where directions meet the cube from -1 to 1."""
    return ways / ways.abs().amax(dim=-1, keepdim=True)


def learnt(resolution: int) -> tuple[Sky, Tensor]:
    """Return a sky whose colours are linear in the place on the cube, and the matrix of it."""
    sky, matrix = sky_of(resolution), torch.randn(3, 3, generator=torch.Generator().manual_seed(1))
    line = torch.linspace(-1, 1, resolution)
    points = grid_points(resolution)
    with torch.no_grad():
        for face, (axis, beside) in enumerate((a, b) for a, b in enumerate(
            [(1, 2), (2, 0), (0, 1)]
        ) for _ in "12"):  # fmt: skip
            place = torch.empty(resolution, resolution, 3)
            place[..., axis] = 1.0 if face % 2 else -1.0
            place[..., beside[0]], place[..., beside[1]] = line[:, None], line[None]
            sky.colours[points[face]] = place @ matrix
    return sky, matrix


@torch.no_grad()
@pytest.mark.parametrize("resolution", [2, 5])
def test_colours_are_linear_between_points_on_all_faces(resolution: int) -> None:
    sky, matrix = learnt(resolution)
    ways = torch.randn(500, 3, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(sky.look(ways), on_cube(ways) @ matrix, atol=1e-4, rtol=1e-4)
    corners = torch.tensor([[1.0, 1, 1], [-1, 1, -1], [1, -1, 0], [0, 0, -1]])
    torch.testing.assert_close(sky.look(corners), corners @ matrix, atol=1e-4, rtol=1e-4)


@torch.no_grad()
def test_there_are_no_seams() -> None:
    """Faces share the points of their edges: 6 (n - 1)^2 + 2 in all."""
    sky = sky_of(5)
    assert len(sky.colours) == 6 * 4**2 + 2
    sky.colours.copy_(torch.rand(98, 3, generator=torch.Generator().manual_seed(3)))
    edge = torch.tensor([[1.0, 1.0, 0.3], [-1.0, 0.4, 1.0], [0.7, -1.0, -1.0]])
    one, other = (sky.look(edge * (1 + s * 1e-5 * torch.tensor([1.0, -1.0, 0.5]))) for s in (1, -1))
    torch.testing.assert_close(one, other, atol=1e-3, rtol=0)


def test_a_sky_is_seen_as_much_as_splats_let_through() -> None:
    sky, matrix = learnt(5)
    rgb, alpha = torch.rand(6, 8, 3), torch.rand(6, 8)
    frame = Frame(rgb, alpha, None, torch.zeros(1), torch.zeros(1, 2))
    found = sky.shade(frame, Instant(0.3, CAMERA)).rgb
    expected = rgb + (1 - alpha)[..., None] * (on_cube(directions(CAMERA).float()) @ matrix)
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=1e-4)
    moment = Moment(splats_of(3))
    assert sky.at(moment, Instant(0.3, CAMERA)) is moment
    begun = sky_of().shade(replace(frame), Instant(0.3, CAMERA)).rgb
    assert torch.equal(begun, rgb)


def test_directions_lead_to_the_pixels_that_they_are_of() -> None:
    ways = normalize(directions(CAMERA), dim=-1).double().numpy()
    seen = (CAMERA.centre + 2.5 * ways) @ CAMERA.rotation.T + CAMERA.translation
    x = CAMERA.fx * seen[..., 0] / seen[..., 2] + CAMERA.cx
    y = CAMERA.fy * seen[..., 1] / seen[..., 2] + CAMERA.cy
    np.testing.assert_allclose(x, np.broadcast_to(np.arange(8) + 0.5, (6, 8)), atol=1e-4)
    np.testing.assert_allclose(y, np.broadcast_to(np.arange(6)[:, None] + 0.5, (6, 8)), atol=1e-4)


def test_gradients_are_those_of_finite_differences() -> None:
    sky = sky_of(3)
    sky.parameters()[0].set_values(torch.rand(26, 3, dtype=torch.float64))
    ways = torch.randn(20, 3, dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda _: sky.look(ways), [sky.colours])


def test_a_sky_of_another_size_is_restored() -> None:
    sky, other = sky_of(7), learnt(4)[0]
    sky.restore({name: tensor.detach() for name, tensor in other.tensors().items()}, 0)
    ways = torch.randn(50, 3)
    assert torch.equal(sky.look(ways), other.look(ways))
    with pytest.raises(ValueError, match=r"a sky of shape \(57, 3\)"):
        sky.restore({"colours": torch.zeros(57, 3)}, 0)


@pytest.mark.parametrize(
    ("options", "found"),
    [({"resolution": 1}, "resolution is 1; allowed: 2 or more"),
     ({"rate": [0.0, 1.0]}, "rate is .*; allowed: .start, end., both above 0")],
)  # fmt: skip
def test_options_out_of_range_are_refused(options: dict[str, object], found: str) -> None:
    with pytest.raises(UsageError, match=found):
        sky_of(**options)  # type: ignore[arg-type]
