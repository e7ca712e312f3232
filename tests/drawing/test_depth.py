"""Depth that is drawn by itself is that of the engine's own frame, and so are its gradients."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from gsdmsr_cli.drawing.depth import draw_depth
from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import scaled_axes
from gsdmsr_cli.raster import load_engine
from gsdmsr_cli.scene.camera import Camera, look_at

POSE = look_at(np.array([2.4, -1.2, 2.96]), np.zeros(3), np.array([0.1, 0.2, 1.0]))
CAMERA = Camera(POSE, 60.0, 55.0, 26.0, 17.0, 50, 37)


def moment_of(count: int, with_axes: bool) -> Moment:
    """Return splats about the origin, the last of them behind the camera."""
    rng = torch.Generator().manual_seed(3)

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng)

    means, quats, log_scales = 0.8 * normal(count, 3), normal(count, 4), -2 + normal(count, 3) / 2
    means[-1] = torch.from_numpy(2 * CAMERA.centre)
    splats = Splats(means, quats, log_scales, 2 * normal(count), 0.3 * normal(count, 4, 3))
    return Moment(splats, scaled_axes(quats, log_scales) if with_axes else None)


def differentiated(frame: Frame, weights: Tensor, by: list[Tensor]) -> list[Tensor]:
    assert frame.depth is not None
    said = (weights[0] * frame.alpha).sum() + (weights[1] * frame.depth).sum()
    found = torch.autograd.grad(said, by, allow_unused=True)
    return [torch.zeros_like(t) if g is None else g for t, g in zip(by, found, strict=True)]


@pytest.mark.parametrize("with_axes", [False, True], ids=["", "axes"])
@pytest.mark.parametrize(("name", "dtype"), [("reference", torch.float64), ("cpu", torch.float32)])
def test_it_is_the_depth_of_the_engine(name: str, dtype: torch.dtype, with_axes: bool) -> None:
    engine = load_engine(name)
    moment = moment_of(80, with_axes).map(lambda t: t.to(dtype).requires_grad_())
    weights = torch.randn(2, 37, 50, generator=torch.Generator().manual_seed(4)).to(dtype)
    whole = engine.rasterize(moment, CAMERA, torch.ones(3, dtype=dtype), with_depth=True)
    alone = draw_depth(moment, CAMERA, engine)
    close = {"rtol": 1e-4, "atol": 1e-4} if dtype == torch.float32 else {}
    torch.testing.assert_close(alone.alpha, whole.alpha, **close)
    torch.testing.assert_close(alone.depth, whole.depth, **close)
    assert whole.alpha.max() > 0.9
    tensors = list(moment.tensors().values())
    expected = differentiated(whole, weights, tensors)
    close = {"rtol": 1e-3, "atol": 2e-3} if dtype == torch.float32 else {}
    for found, right in zip(differentiated(alone, weights, tensors), expected, strict=True):
        torch.testing.assert_close(found, right, **close)
    assert expected[0].abs().max() > 1
