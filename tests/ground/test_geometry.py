"""Rotations and spherical harmonics against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from scipy.spatial.transform import Rotation
from torch import Tensor

from gsdmsr_cli.ground.geometry import (
    covariance,
    nearest_quats,
    quat_product,
    quat_to_rotmat,
    sh_basis,
)

COMPONENT = st.floats(-1, 1, allow_subnormal=False)
QUATS = st.tuples(COMPONENT, COMPONENT, COMPONENT, COMPONENT).filter(
    lambda q: math.hypot(*q) > 1e-2
)


def tensor(*rows: tuple[float, ...]) -> Tensor:
    return torch.tensor(rows, dtype=torch.float64)


@settings(deadline=None)
@given(QUATS, st.floats(-8, 8))
def test_rotations_are_proper_at_any_norm(quat: tuple[float, ...], exponent: float) -> None:
    rotation = quat_to_rotmat(tensor(quat) * 10**exponent)[0]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64))
    assert rotation.det().item() == pytest.approx(1)
    torch.testing.assert_close(rotation, quat_to_rotmat(tensor(quat))[0])


@settings(deadline=None)
@given(QUATS)
def test_a_quaternion_and_its_negative_are_one_rotation(quat: tuple[float, ...]) -> None:
    assert torch.equal(quat_to_rotmat(tensor(quat)), quat_to_rotmat(-tensor(quat)))


@settings(deadline=None)
@given(st.tuples(COMPONENT, COMPONENT, COMPONENT).filter(lambda v: math.hypot(*v) > 1e-2))
def test_rotation_is_the_exponential_of_the_angle_vector(vector: tuple[float, ...]) -> None:
    x, y, z = vector
    angle = math.hypot(x, y, z)
    half = math.sin(angle / 2) / angle
    expected = torch.linalg.matrix_exp(tensor((0, -z, y), (z, 0, -x), (-y, x, 0)))
    found = quat_to_rotmat(tensor((math.cos(angle / 2), x * half, y * half, z * half)))[0]
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("size", [0.0, 1e-20, 1e-12, 1e-6])
def test_near_zero_quaternions_stay_finite(dtype: torch.dtype, size: float) -> None:
    quats = torch.tensor([[0.5, -0.5, 0.1, 0.7]], dtype=dtype).mul(size).requires_grad_()
    rotation = quat_to_rotmat(quats)
    assert rotation.dtype == dtype
    rotation.square().sum().backward()
    assert quats.grad is not None
    assert rotation.isfinite().all()
    assert quats.grad.isfinite().all()
    if size == 0:
        assert torch.equal(rotation[0], torch.eye(3, dtype=dtype))
        assert torch.equal(quats.grad, torch.zeros_like(quats))


def test_covariance_has_the_scales_as_axes() -> None:
    quats, log_scales = tensor((1.2, -0.3, 0.4, 2.0)), tensor((-1.0, 0.5, 0.2))
    found = covariance(quats, log_scales)[0]
    axes = quat_to_rotmat(quats)[0]
    torch.testing.assert_close(found @ axes, axes * (2 * log_scales[0]).exp())


def harmonic(degree: int, order: int, z: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """Real spherical harmonic with Condon-Shortley phase, by Rodrigues' formula."""
    m = abs(order)
    derived = (Polynomial([-1, 0, 1]) ** degree).deriv(degree + m)
    legendre = (-1) ** m * (1 - z * z) ** (m / 2) * derived(z) / 2**degree
    legendre /= math.factorial(degree)
    ratio = math.factorial(degree - m) / math.factorial(degree + m)
    wave = np.ones_like(phi)
    if order:
        wave = math.sqrt(2) * (np.cos(m * phi) if order > 0 else np.sin(m * phi))
    return math.sqrt((2 * degree + 1) / (4 * math.pi) * ratio) * legendre * wave


def sphere() -> tuple[np.ndarray, np.ndarray, np.ndarray, Tensor]:
    """z, azimuth, weights and unit vectors of a quadrature exact up to degree 15."""
    nodes, node_weights = np.polynomial.legendre.leggauss(8)
    phi, z = np.meshgrid(np.arange(16) * 2 * np.pi / 16 + 0.1, nodes)
    phi, z = phi.ravel(), z.ravel()
    flat = np.sqrt(1 - z * z)
    directions = torch.from_numpy(np.stack([flat * np.cos(phi), flat * np.sin(phi), z], -1))
    return z, phi, np.repeat(node_weights, 16) * 2 * np.pi / 16, directions


def test_harmonics_are_orthonormal() -> None:
    _, _, weights, directions = sphere()
    basis = sh_basis(directions, 3)
    gram = basis.T @ (torch.from_numpy(weights)[:, None] * basis)
    torch.testing.assert_close(gram, torch.eye(16, dtype=torch.float64), atol=1e-8, rtol=0)


@pytest.mark.parametrize("degree", range(4))
def test_harmonics_follow_rodrigues_in_order_and_sign(degree: int) -> None:
    z, phi, _, directions = sphere()
    expected = [harmonic(n, m, z, phi) for n in range(degree + 1) for m in range(-n, n + 1)]
    found = sh_basis(directions, degree)
    np.testing.assert_allclose(found.numpy(), np.stack(expected, -1), atol=1e-8)


@pytest.mark.parametrize("degree", [-1, 4])
def test_unknown_degree_is_an_error(degree: int) -> None:
    with pytest.raises(ValueError, match="0 to 3"):
        sh_basis(tensor((0.0, 0.0, 1.0)), degree)


def test_products_of_quaternions_turn_by_the_second_first() -> None:
    quats = torch.randn(2, 5, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    first, second = (Rotation.from_quat(part.numpy(), scalar_first=True) for part in quats)
    found = quat_to_rotmat(quat_product(quats[0], quats[1]))
    np.testing.assert_allclose(found, (first * second).as_matrix(), atol=1e-12)


@settings(deadline=None)
@given(QUATS, st.integers(0, 1000))
def test_the_nearest_quaternion_is_the_rotation_that_fits(
    quat: tuple[float, ...], seed: int
) -> None:
    rng = torch.Generator().manual_seed(seed)
    before = torch.randn(3, 6, 3, dtype=torch.float64, generator=rng)
    turn = quat_to_rotmat(tensor(quat))
    after = before @ turn.mT
    found = quat_to_rotmat(nearest_quats(after.mT @ before))
    torch.testing.assert_close(found, turn.expand(3, 3, 3), atol=1e-6, rtol=0)
    noisy = after + torch.randn(after.shape, dtype=torch.float64, generator=rng)
    best = quat_to_rotmat(nearest_quats(noisy.mT @ before))
    for one, x, y in zip(best, before, noisy, strict=True):
        expected = Rotation.align_vectors(y.numpy(), x.numpy())[0].as_matrix()
        np.testing.assert_allclose(one, expected, atol=1e-6)


def test_the_nearest_quaternion_of_nothing_is_the_identity() -> None:
    assert nearest_quats(torch.zeros(2, 3, 3)).tolist() == [[1, 0, 0, 0]] * 2
