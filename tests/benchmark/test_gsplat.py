"""gsplat is given what its documentation asks for: by a stand-in that draws with the reference."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from gsdmsr_cli.benchmark import gsplat
from gsdmsr_cli.benchmark.cloud import camera, cloud
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.raster import reference
from gsdmsr_cli.scene.camera import Camera

SIZE, COUNT = 24, 90


def rasterization(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor,
    viewmats: Tensor, Ks: Tensor, width: int, height: int, *, near_plane: float, packed: bool,
    backgrounds: Tensor,
) -> tuple[Tensor, Tensor, dict[str, Any]]:  # fmt: skip
    """Draw one view as gsplat 1.5 documents its arguments and results."""
    assert scales.shape == (COUNT, 3) and opacities.shape == (COUNT,) and colors.shape == (COUNT, 3)
    assert viewmats.shape == (1, 4, 4) and Ks.shape == (1, 3, 3) and backgrounds.shape == (1, 3)
    (fx, _, cx), (_, fy, cy), _ = Ks[0].tolist()
    view = Camera(viewmats[0].double().numpy(), fx, fy, cx, cy, width, height)
    sh = ((colors - 0.5) / SH_C0)[:, None]
    splats = Splats(means, quats, scales.log(), opacities.logit(), sh)
    frame = reference.rasterize(Moment(splats), view, backgrounds[0])
    return frame.rgb[None], frame.alpha[None, ..., None], {}


def test_it_draws_what_we_draw() -> None:
    module = SimpleNamespace(rasterization=rasterization)
    found = gsplat.drawing(module, SIZE, COUNT, "cpu")()
    expected = reference.rasterize(Moment(cloud(COUNT)), camera(SIZE), torch.ones(3)).rgb
    torch.testing.assert_close(found, expected, atol=1e-4, rtol=0)


def test_without_it_there_is_a_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str, *rest: Any) -> Any:
        raise ImportError("No module named 'gsplat'")

    monkeypatch.setattr(gsplat.importlib, "import_module", fail)
    assert gsplat.load_gsplat() == "gsplat cannot be imported: No module named 'gsplat'"
