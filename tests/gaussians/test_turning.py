"""The world of splats turned and scaled: what is seen from a camera that turns with it stays."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from motion_checks import splats_of

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.gaussians.turning import turn_harmonics, turn_world
from gsdmsr_cli.ground.geometry import covariance, quat_to_rotmat, sh_basis

UPRIGHT = torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]], dtype=torch.float64)


def rotations(count: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(3)
    quats = torch.randn(count, 4, generator=generator, dtype=torch.float64)
    return torch.cat([quat_to_rotmat(quats), UPRIGHT[None]])


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics_have_in_turned_directions_the_values_that_they_had(degree: int) -> None:
    generator = torch.Generator().manual_seed(degree)
    sh = torch.randn(5, (degree + 1) ** 2, 3, generator=generator, dtype=torch.float64)
    directions = torch.randn(40, 3, generator=generator, dtype=torch.float64)
    directions /= directions.norm(dim=1, keepdim=True)
    for rotation in rotations(4):
        before = torch.einsum("dk,nkc->ndc", sh_basis(directions, degree), sh)
        turned = turn_harmonics(sh, rotation)
        after = torch.einsum("dk,nkc->ndc", sh_basis(directions @ rotation.mT, degree), turned)
        torch.testing.assert_close(after, before, rtol=0, atol=1e-12)
        if degree:
            assert (turned - sh).abs().max() > 0.1


def double(count: int) -> Splats:
    return splats_of(count).map(torch.Tensor.double)


def test_means_and_covariances_turn_and_grow_with_the_world() -> None:
    splats = double(20)
    for rotation in rotations(3):
        found = turn_world(splats, rotation, 2.5)
        torch.testing.assert_close(found.means, 2.5 * splats.means @ rotation.T)
        expected = rotation @ covariance(splats.quats, splats.log_scales) @ rotation.T
        torch.testing.assert_close(covariance(found.quats, found.log_scales), 2.5**2 * expected)
        assert torch.equal(found.logit_opacities, splats.logit_opacities)


def test_two_turns_are_their_product_and_no_turn_changes_nothing() -> None:
    splats, (first, second) = double(6), rotations(1)
    splats = replace(splats, sh=torch.randn(6, 16, 3, dtype=torch.float64))
    together, apart = turn_world(splats, second @ first), turn_world(splats, first)
    apart = turn_world(apart, second)
    torch.testing.assert_close(apart.sh, together.sh, rtol=0, atol=1e-12)
    torch.testing.assert_close(apart.means, together.means)
    same = turn_world(splats, torch.eye(3, dtype=torch.float64))
    for name, tensor in splats.tensors().items():
        torch.testing.assert_close(getattr(same, name), tensor, rtol=0, atol=1e-12)
