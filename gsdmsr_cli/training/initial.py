"""The splats a training starts from: the scene's points, or random ones."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gsdmsr_cli.geometry import SH_C0
from gsdmsr_cli.pictures import Pictures
from gsdmsr_cli.preset import SplatOptions
from gsdmsr_cli.scene import Scene
from gsdmsr_cli.splats import Splats
from gsdmsr_cli.training.silhouettes import sample_points

NEIGHBOURS = 3


def initial_splats(
    scene: Scene,
    options: SplatOptions,
    pictures: Pictures,
    background: Tensor,
    generator: torch.Generator,
) -> Splats:
    """Return isotropic splats as large as the distance to their neighbours (3DGS, section 5.1).

    They sit at the scene's own points, else at random in its box: evenly and nearly grey as all
    methods do on D-NeRF, or where silhouettes overlap (see ``silhouettes``).
    """
    if len(scene.points):
        means, colours = torch.from_numpy(scene.points), torch.from_numpy(scene.colours)
    elif options.start == "silhouettes":
        means, colours = sample_points(scene, pictures, background, options.count, generator)
    else:
        means = (2 * torch.rand(options.count, 3, generator=generator) - 1) * scene.bound
        colours = 0.5 + SH_C0 * torch.rand(options.count, 3, generator=generator) / 255
    n = len(means)
    sh = torch.zeros(n, (options.sh_degree + 1) ** 2, 3)
    sh[:, 0] = (colours - 0.5) / SH_C0
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1
    return Splats(
        means=means,
        quats=quats,
        log_scales=_spacing(means, scene.bound).log()[:, None].repeat(1, 3),
        logit_opacities=torch.full((n,), math.log(options.opacity / (1 - options.opacity))),
        sh=sh,
    )


def _spacing(means: Tensor, bound: float) -> Tensor:
    """Return the root mean square distance of each mean to its three nearest neighbours (N,)."""
    count = min(NEIGHBOURS, len(means) - 1)
    if count < 1:
        return torch.full((len(means),), 0.1 * bound)
    squares = []
    means = means - means.mean(dim=0)  # cdist multiplies, which cancels far from the origin
    for chunk in means.split(1024):
        nearest = torch.cdist(chunk, means).topk(count + 1, largest=False).values[:, 1:]
        squares.append(nearest.square().mean(dim=1))
    return torch.cat(squares).clamp(min=1e-7).sqrt()
