"""Turns and scales the world in which splats stand: means, rotations, scales and harmonics."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import nearest_quats, quat_product, sh_basis


def turn_world(splats: Splats, rotation: Tensor, scale: float = 1.0) -> Splats:
    """Return the splats in other axes and units, which look the same from where a camera goes too.

    Args:
        splats: in the old world.
        rotation: (3, 3) from old directions to new ones, of determinant 1, float64.
        scale: new units in an old one, more than 0.
    """
    turn = nearest_quats(rotation).to(splats.quats).expand_as(splats.quats)
    return replace(
        splats,
        means=scale * splats.means @ rotation.to(splats.means).mT,
        quats=quat_product(turn, splats.quats),
        log_scales=splats.log_scales + torch.tensor(scale, dtype=torch.float64).log().item(),
        sh=turn_harmonics(splats.sh, rotation),
    )


def turn_harmonics(sh: Tensor, rotation: Tensor) -> Tensor:
    """Return coefficients (N, K, 3) whose sum in direction R d is that of ``sh`` in direction d.

    rotation is R, (3, 3) float64.
    """
    degree = int(sh.shape[1] ** 0.5) - 1
    blocks = [_turn_of_degree(each, rotation) for each in range(degree + 1)]
    return torch.einsum("kj,njc->nkc", torch.block_diag(*blocks).to(sh), sh)


def _turn_of_degree(degree: int, rotation: Tensor) -> Tensor:
    """Return the (2 l + 1, 2 l + 1) matrix that turns coefficients of degree l.

    Harmonics of one degree span a space that rotations do not leave, so values in more directions
    than it has dimensions determine the matrix: it is solved for, and exact but for rounding.
    """
    generator = torch.Generator().manual_seed(0)
    directions = torch.randn(64, 3, generator=generator, dtype=torch.float64)
    directions /= directions.norm(dim=1, keepdim=True)
    block = slice(degree**2, (degree + 1) ** 2)
    before = sh_basis(directions, degree)[:, block]
    after = sh_basis(directions @ rotation.mT, degree)[:, block]
    solution: Tensor = torch.linalg.lstsq(after, before).solution
    return solution
