"""gsplat, the field's CUDA rasteriser, given the same splats where it is installed."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from gsdmsr_cli.benchmark import workloads
from gsdmsr_cli.benchmark.cloud import camera, cloud
from gsdmsr_cli.ground.geometry import SH_C0


def load_gsplat() -> Any:
    """Return the module, or the reason why there is none, one clause."""
    try:
        return importlib.import_module("gsplat")
    except (ImportError, OSError) as error:
        return f"gsplat cannot be imported: {error}"


def drawing(module: Any, size: int, count: int, device: str = "cuda") -> Callable[[], Tensor]:
    """Return a function that draws and goes back, as ``workloads.drawing`` does, and the picture.

    From the same stored values: the activations, which our kernels contain, are torch's here.
    """
    stored = [t.to(device).requires_grad_(True) for t in cloud(count).tensors().values()]
    means, quats, log_scales, logit_opacities, sh = stored
    view = camera(size)
    world_to_camera = torch.from_numpy(view.world_to_camera).float().to(device)
    intrinsics = torch.tensor([[view.fx, 0, view.cx], [0, view.fy, view.cy], [0, 0, 1]]).to(device)
    background = torch.ones(1, 3, device=device)
    slope = workloads.slope_of(size, device).permute(1, 2, 0)

    def run() -> Tensor:
        colours = (0.5 + SH_C0 * sh[:, 0]).clamp(min=0)
        pictures, _alpha, _about = module.rasterization(
            means, quats, log_scales.exp(), logit_opacities.sigmoid(), colours,
            world_to_camera[None], intrinsics[None], size, size, near_plane=0.2, packed=False,
            backgrounds=background,
        )  # fmt: skip
        pictures[0].backward(slope)
        for tensor in stored:
            tensor.grad = None
        workloads.wait(device)
        picture: Tensor = pictures[0].detach()
        return picture

    return run
