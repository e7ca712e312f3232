"""The reference engine: plain torch without tiles, to which every other engine is compared."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import covariance, sh_basis
from gsdmsr_cli.ground.splatting_constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    DILATION,
    FRUSTUM_MARGIN,
    NEAR,
    TRANSMITTANCE_STOP,
)
from gsdmsr_cli.scene.camera import Camera

PAIRS_AT_ONCE = 1 << 21
"""Pixel-splat pairs that are blended at a time; bounds the memory, not the result."""


class Projection(NamedTuple):
    """N splats as a camera sees them: what blending needs, except colour."""

    means2d: Tensor  # (N, 2) [px]
    covs2d: Tensor  # (N, 2, 2), dilated [px^2]
    depths: Tensor  # (N,) camera z [world units]
    opacities: Tensor  # (N,)


def unavailable(device: str) -> str | None:
    """Return why the engine cannot draw tensors on ``device``, or None if it can."""
    if device == "cuda" and not torch.cuda.is_available():
        return "torch finds no CUDA device"
    return None


def rasterize(
    moment: Moment,
    camera: Camera,
    background: Tensor,
    sh_degree: int | None = None,
    with_depth: bool = False,
) -> Frame:
    """Draw the moment in the dtype and on the device of its tensors.

    The formulas are those of 3DGS (Kerbl et al. 2023) with EWA projection (Zwicker et al. 2001).
    Splats that are not drawn have radius 0, means2d 0 and a zero gradient.

    Args:
        moment: N splats.
        camera: gives the H x W pixels.
        background: (3,) colour behind the splats.
        sh_degree: highest degree of the harmonics used, all that are stored by default.
        with_depth: whether to blend camera z too.
    """
    degree = moment.splats.degree_up_to(sh_degree)
    rows, radii = _drawn(moment, camera)
    drawn = moment.take(rows)
    projected = project(drawn, camera)
    # Blending reads the screen means through the frame's tensor, so that this has their gradient.
    means2d = torch.zeros_like(moment.splats.means[:, :2]).index_put((rows,), projected.means2d)
    projected = projected._replace(means2d=means2d[rows])
    channels = [_colours(drawn.splats, camera, degree)]
    if with_depth:
        channels.append(projected.depths.unsqueeze(-1))
    if drawn.features is not None:
        channels.append(drawn.features)
    blended, alpha = _blend(projected, torch.cat(channels, -1), camera)
    rgb = blended[..., :3] + (1 - alpha).unsqueeze(-1) * background.to(blended)
    depth = blended[..., 3] if with_depth else None
    features = None if drawn.features is None else blended[..., 3 + with_depth :]
    return Frame(rgb, alpha, depth, radii, means2d, features)


def project(moment: Moment, camera: Camera) -> Projection:
    """Project the Gaussians with the Jacobian of the pinhole at their means.

    Inside the Jacobian x/z is clamped to FRUSTUM_MARGIN times half the image's width over fx,
    symmetric about the optical axis as in 3DGS also where the principal point is off-centre, and
    y/z likewise. A clamped slope is a constant: no gradient passes through it.
    """
    splats, axes = moment.splats, moment.axes
    rotation = splats.means.new_tensor(camera.rotation)
    x, y, z = (splats.means @ rotation.T + splats.means.new_tensor(camera.translation)).unbind(-1)
    limit_x = FRUSTUM_MARGIN * 0.5 * camera.width / camera.fx
    limit_y = FRUSTUM_MARGIN * 0.5 * camera.height / camera.fy
    dx_dz = -camera.fx * (x / z).clamp(-limit_x, limit_x) / z
    dy_dz = -camera.fy * (y / z).clamp(-limit_y, limit_y) / z
    zero = torch.zeros_like(z)
    jacobian = torch.stack([camera.fx / z, zero, dx_dz, zero, camera.fy / z, dy_dz], -1)
    to_screen = jacobian.reshape(-1, 2, 3) @ rotation
    covs = covariance(splats.quats, splats.log_scales) if axes is None else axes @ axes.mT
    covs2d = to_screen @ covs @ to_screen.mT
    return Projection(
        means2d=torch.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], -1),
        covs2d=covs2d + DILATION * torch.eye(2).to(covs2d),
        depths=z,
        opacities=splats.logit_opacities.sigmoid(),
    )


@torch.no_grad()
def _drawn(moment: Moment, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return the rows that are drawn, (M,) from front to back, and all radii, (N,) [px].

    A splat is drawn if all its values that are read are finite, it is in front of the near plane,
    the determinant of its screen covariance is finite and positive, and the box around the ellipse
    where its alpha is at least ALPHA_MIN touches the image. The radius is the larger half side of
    that box.
    """
    seen = project(moment, camera)
    det = _det(seen.covs2d)
    keep = (seen.depths > NEAR) & (seen.opacities >= ALPHA_MIN) & (det > 0) & det.isfinite()
    for tensor in moment.tensors().values():
        keep &= tensor.isfinite().unsqueeze(-1).flatten(1).all(-1)
    mahalanobis2 = 2 * (seen.opacities / ALPHA_MIN).log()
    variances = seen.covs2d.diagonal(dim1=-2, dim2=-1)
    half_sides = (mahalanobis2.unsqueeze(-1) * variances).sqrt()
    size = seen.means2d.new_tensor([camera.width, camera.height])
    keep &= ((seen.means2d > -half_sides) & (seen.means2d < size + half_sides)).all(-1)
    rows = keep.nonzero().squeeze(-1)
    rows = rows[seen.depths[rows].argsort(stable=True)]
    return rows, half_sides.amax(-1).where(keep, 0.0)


def _colours(splats: Splats, camera: Camera, degree: int) -> Tensor:
    """Return the (N, 3) colours seen from the camera's centre, not below 0."""
    directions = splats.means - splats.means.new_tensor(camera.centre)
    basis = sh_basis(torch.nn.functional.normalize(directions, dim=-1), degree)
    sums = (basis.unsqueeze(-1) * splats.sh[:, : basis.shape[-1]]).sum(-2)
    return (0.5 + sums).clamp(min=0)


def _det(matrices: Tensor) -> Tensor:
    """Return the (N,) determinants of (N, 2, 2) symmetric matrices."""
    return matrices[:, 0, 0] * matrices[:, 1, 1] - matrices[:, 0, 1] ** 2


def _blend(splats: Projection, features: Tensor, camera: Camera) -> tuple[Tensor, Tensor]:
    """Return the blended features, (H, W, F), and alpha, (H, W); splats are front to back."""
    xs = torch.arange(camera.width).to(features) + 0.5
    ys = torch.arange(camera.height).to(features) + 0.5
    pixels = torch.cartesian_prod(ys, xs).flip(-1)
    chunk = math.ceil(PAIRS_AT_ONCE / max(1, len(features)))
    weighted = torch.cat([features, torch.ones_like(features[:, :1])], -1)
    parts = [
        checkpoint(
            _blend_pixels,
            part,
            splats.means2d,
            splats.covs2d,
            splats.opacities,
            weighted,
            use_reentrant=False,
            preserve_rng_state=False,
        )
        for part in torch.split(pixels, chunk)
    ]
    blended = torch.cat(parts).reshape(camera.height, camera.width, -1)
    return blended[..., :-1], blended[..., -1]


def _blend_pixels(
    pixels: Tensor,  # (P, 2) centres [px]
    means2d: Tensor,
    covs2d: Tensor,
    opacities: Tensor,
    features: Tensor,  # (N, F)
) -> Tensor:
    """Return the (P, F) sums of the features weighted by alpha times transmittance."""
    dx, dy = (pixels.unsqueeze(1) - means2d).unbind(-1)  # (P, N) each
    xx, xy, yy = covs2d[:, 0, 0], covs2d[:, 0, 1], covs2d[:, 1, 1]
    distance2 = (yy * dx * dx - 2 * xy * dx * dy + xx * dy * dy) / _det(covs2d)
    alphas = opacities * (-0.5 * distance2).exp()
    alphas = alphas.clamp(max=ALPHA_MAX).where(alphas >= ALPHA_MIN, 0.0)
    after = (1 - alphas).cumprod(-1)
    before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], -1)[:, : after.shape[1]]
    # Transmittance only falls, so what the mask drops cannot matter to what it keeps.
    weights = (alphas * before).where(before >= TRANSMITTANCE_STOP, 0.0)
    return weights @ features
