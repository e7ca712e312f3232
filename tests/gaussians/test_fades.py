"""Opacities that are multiplied by a factor: the closed form, its ends, and its gradients."""

from __future__ import annotations

import pytest
import torch

from gsdmsr_cli.gaussians.fading import MOST, fade, thin

LOGITS = torch.tensor([-30.0, -4.0, 0.0, 3.0, 20.0, 60.0], dtype=torch.float64)
EXPONENTS = torch.tensor([0.0, 1e-9, 0.3, 2.0, 40.0], dtype=torch.float64)


def grid() -> tuple[torch.Tensor, torch.Tensor]:
    logits, exponents = torch.meshgrid(LOGITS, EXPONENTS, indexing="ij")
    return logits.flatten(), exponents.flatten()


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 2e-6)])
def test_it_is_the_product(dtype: torch.dtype, tolerance: float) -> None:
    logits, exponents = grid()
    expected = torch.sigmoid(logits) * torch.exp(-exponents)
    found = fade(logits.to(dtype), exponents.to(dtype))
    torch.testing.assert_close(torch.sigmoid(found.double()), expected, rtol=tolerance, atol=0)


def test_an_exponent_of_zero_changes_nothing() -> None:
    logits = LOGITS.float()
    torch.testing.assert_close(fade(logits, torch.zeros(6)), logits, rtol=1e-6, atol=1e-6)


def test_its_gradients_are_right() -> None:
    logits, exponents = grid()
    given = logits.requires_grad_(), (exponents + 0.01).requires_grad_()
    assert torch.autograd.gradcheck(fade, given)


def test_what_is_beyond_all_bounds_stays_finite_and_so_do_its_gradients() -> None:
    logits = torch.tensor([-1e6, 1e6, 0.0, 0.0, 90.0]).requires_grad_()
    exponents = torch.tensor([0.5, 0.5, 1e30, torch.inf, 0.0]).requires_grad_()
    found = fade(logits, exponents)
    found.sum().backward()
    for tensor in (found, logits.grad, exponents.grad):
        assert tensor is not None and tensor.isfinite().all()
    assert found[2:4].tolist() == pytest.approx([-MOST, -MOST], rel=0.01)


@pytest.mark.parametrize("share", [0.7, 0.5, 1e-3])
def test_shares_of_a_splat_let_through_what_it_does(share: float) -> None:
    one, other = (torch.sigmoid(-thin(LOGITS, own)) for own in (share, 1 - share))
    torch.testing.assert_close(one * other, torch.sigmoid(-LOGITS), rtol=1e-9, atol=0)


def test_a_share_of_nothing_and_of_all_stays_finite() -> None:
    logits = torch.tensor([-1e6, -80.0, 0.0, 80.0, 1e6])
    for share in (1.0, 0.5, 1e-12):
        assert thin(logits, share).isfinite().all()
    torch.testing.assert_close(thin(LOGITS.float(), 1.0), LOGITS.float(), rtol=1e-6, atol=1e-6)
