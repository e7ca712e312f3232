"""Rotations, covariances and spherical harmonics in torch, in the dtype of their arguments."""

from __future__ import annotations

import torch
from torch import Tensor

SH_C0 = 0.28209479177387814
SH_C1 = 0.4886025119029199
SH_C2 = (
    1.0925484305920792,
    -1.0925484305920792,
    0.31539156525252005,
    -1.0925484305920792,
    0.5462742152960396,
)
SH_C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)
"""Factors of the real spherical harmonics with Condon-Shortley phase, as in 3DGS."""

QUAT_NORM2_FLOOR = 1e-24
"""Least squared norm of a quaternion; shorter ones are not stretched to unit length."""


def quat_to_rotmat(quats: Tensor) -> Tensor:
    """Return the (N, 3, 3) rotations of (N, 4) quaternions wxyz of any norm.

    Quaternions are divided by their norm, which is held above the root of QUAT_NORM2_FLOOR. So a
    zero quaternion gives the identity with a zero gradient, shorter ones than the floor something
    near the identity, and all of them finite gradients.
    """
    norm2 = (quats * quats).sum(-1, keepdim=True).clamp(min=QUAT_NORM2_FLOOR)
    w, x, y, z = (quats / norm2.sqrt()).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z),
        2 * (x * y - w * z),
        2 * (x * z + w * y),
        2 * (x * y + w * z),
        1 - 2 * (x * x + z * z),
        2 * (y * z - w * x),
        2 * (x * z - w * y),
        2 * (y * z + w * x),
        1 - 2 * (x * x + y * y),
    ]
    return torch.stack(rows, -1).reshape(-1, 3, 3)


def quat_product(first: Tensor, second: Tensor) -> Tensor:
    """Return the Hamilton products of quaternions (..., 4) wxyz, which turn by ``second`` first."""
    a, b, c, d = first.unbind(-1)
    w, x, y, z = second.unbind(-1)
    parts = [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
    return torch.stack(parts, dim=-1)


def nearest_quats(matrices: Tensor) -> Tensor:
    """Return the unit quaternions (..., 4) of the rotations R with the largest trace of Rᵀ M.

    Of M (..., 3, 3) = sum w y xᵀ that rotation takes x to y with the least sum of squares: the
    eigenvector of the largest eigenvalue of a symmetric matrix (Horn 1987, section 4). Without a
    gradient; the identity where M is 0.
    """
    (a, b, c), (d, e, f), (g, h, i) = (row.unbind(-1) for row in matrices.detach().unbind(-2))
    rows = [
        [a + e + i, h - f, c - g, d - b],
        [h - f, a - e - i, b + d, c + g],
        [c - g, b + d, e - a - i, f + h],
        [d - b, c + g, f + h, i - a - e],
    ]
    largest = torch.linalg.eigh(torch.stack([torch.stack(row, -1) for row in rows], -2))[1][..., -1]
    nowhere = (matrices == 0).all(dim=-1).all(dim=-1)[..., None]
    return torch.where(nowhere, largest.new_tensor([1.0, 0.0, 0.0, 0.0]), largest)


def as_rigid_as_possible(after: Tensor, before: Tensor, weights: Tensor) -> Tensor:
    """Return |after - R before|^2 (S, K) with the rotation R of each neighbourhood that fits best.

    Sorkine & Alexa (SGP 2007), equation 3. The energy has no gradient by its best rotation.

    Args:
        after, before: (S, K, 3) ways from a point to its K neighbours.
        weights: (S, K) of the neighbours in the fit.
    """
    with torch.no_grad():
        turns = quat_to_rotmat(nearest_quats((weights[:, :, None] * after).mT @ before))
    return (after - before @ turns.mT).square().sum(dim=2)


def scaled_axes(quats: Tensor, log_scales: Tensor) -> Tensor:
    """Return the (N, 3, 3) matrices R diag(exp(log_scales)), whose columns are axes [world units].

    quats is (N, 4) wxyz of any norm, log_scales (N, 3).
    """
    return quat_to_rotmat(quats) * log_scales.exp().unsqueeze(-2)


def covariance(quats: Tensor, log_scales: Tensor) -> Tensor:
    """Return the (N, 3, 3) covariances R diag(exp(log_scales))^2 R^T [world units^2].

    quats is (N, 4) wxyz of any norm, log_scales (N, 3).
    """
    axes = scaled_axes(quats, log_scales)
    return axes @ axes.mT


def sh_basis(directions: Tensor, degree: int) -> Tensor:
    """Return the (N, (degree + 1)^2) real spherical harmonics of (N, 3) unit vectors.

    Ordered by l, then by m from -l to l, with the factors and signs of 3DGS; degree is 0 to 3.

    Raises:
        ValueError: the degree is outside 0 to 3.
    """
    if not 0 <= degree <= 3:
        raise ValueError(f"spherical harmonics of degree {degree}; known are 0 to 3")
    x, y, z = directions.unbind(-1)
    terms = [torch.full_like(x, SH_C0)]
    if degree >= 1:
        terms += [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    xx, yy, zz = x * x, y * y, z * z
    if degree >= 2:
        terms += [
            SH_C2[0] * x * y,
            SH_C2[1] * y * z,
            SH_C2[2] * (2 * zz - xx - yy),
            SH_C2[3] * x * z,
            SH_C2[4] * (xx - yy),
        ]
    if degree >= 3:
        terms += [
            SH_C3[0] * y * (3 * xx - yy),
            SH_C3[1] * x * y * z,
            SH_C3[2] * y * (4 * zz - xx - yy),
            SH_C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            SH_C3[4] * x * (4 * zz - xx - yy),
            SH_C3[5] * z * (xx - yy),
            SH_C3[6] * x * (xx - 3 * yy),
        ]
    return torch.stack(terms, -1)
