"""Splats that follow the nodes near them: SC-GS's sparse control points (Huang et al., CVPR 2024).

Linear blend skinning, section 3.2 there: a node at p with rotation R and offset T takes a place x
to R (x - p) + p + T, and a splat goes to the weighted mean of what its nearest nodes make of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.fields.deformation import PARTS
from gsdmsr_cli.geometry import quat_to_rotmat
from gsdmsr_cli.kernels import skinning as kernels
from gsdmsr_cli.kernels.neighbours import mean_squares, near_order
from gsdmsr_cli.splats import Splats
from gsdmsr_cli.tensors import array, has_kernels

COLUMNS = [9, 3, 4, 3]
"""Columns of a transform, see ``kernels.skinning``: matrix, offset, quaternion, log scales."""

SPACING_OF = 3
"""How many of the nearest other nodes say how far apart nodes are."""

_CHUNK = 8192

_COINCIDENT = 1e-4
"""Squares of distances count as this share of their mean at least: rounding would count else."""


def spread_nodes(points: Tensor, count: int) -> Tensor:
    """Return ``count`` of the points (N, 3) that are far from each other, on the CPU.

    Some repeatedly if there are fewer. Nodes that follow each other lie near each other, which
    makes ``nearest_nodes`` quick.
    """
    given = points.detach().cpu().double().contiguous()
    rows = torch.empty(count, dtype=torch.int64)
    kernels.choose_spread(array(given), array(rows))
    nodes = given[rows]
    return nodes[torch.from_numpy(near_order(array(nodes)))].float()


def spacing(nodes: Tensor) -> Tensor:
    """Return the root mean square of the distances of each node to its nearest others, (M,)."""
    squares = mean_squares(array(nodes.detach().cpu().double().contiguous()), SPACING_OF)
    return torch.from_numpy(squares).sqrt().float()


@torch.no_grad()
def nearest_nodes(points: Tensor, nodes: Tensor, near: Tensor) -> Tensor:
    """Return the rows of the nearest nodes of each point, in ascending order, (N, K) int32.

    Args:
        points, nodes: (N, 3), (M, 3).
        near: (N, K) int32, rows that may be the nearest's, as those of a moment ago are, or zeros:
            what they are changes nothing but the time it takes. K is at most M.
    """
    if has_kernels(points, nodes):
        found = near.clone()
        kernels.nearest(array(points.contiguous()), array(nodes.contiguous()), array(found))
        return found
    parts = [torch.empty_like(near[:0])]
    for some in points.split(_CHUNK):
        distances = (some[:, None] - nodes).square().sum(dim=2)
        found = distances.topk(near.shape[1], largest=False).indices
        parts.append(found.sort(dim=1).values.to(torch.int32))
    return torch.cat(parts)


def transforms(nodes: Tensor, deformation: Tensor) -> Tensor:
    """Return what nodes (M, 3) do to the splats that follow them, (M, 19), see ``COLUMNS``.

    Args:
        nodes: their canonical places.
        deformation: (M, 10) offset of the place, of the quaternion (1, 0, 0, 0), which is then of
            unit length, and of the log scales.
    """
    if has_kernels(nodes, deformation):
        made: Tensor = _Transform.apply(nodes, deformation)
        return made
    return transforms_twin(nodes, deformation)


def transforms_twin(nodes: Tensor, deformation: Tensor) -> Tensor:
    """Return what ``transforms`` does, in plain torch, for any device and dtype."""
    offset, turn, growth = deformation.split(PARTS, dim=1)
    nothing = torch.zeros_like(turn)
    nothing[:, 0] = 1
    quats = torch.nn.functional.normalize(nothing + turn, dim=1, eps=kernels.SHORTEST)
    matrix = quat_to_rotmat(quats) - torch.eye(3, dtype=turn.dtype, device=turn.device)
    shift = offset - (matrix @ nodes[:, :, None])[:, :, 0]
    return torch.cat([matrix.flatten(1), shift, quats - nothing, growth], dim=1)


def rigidity(nodes: Tensor, transforms: Tensor, near: Tensor) -> Tensor:
    """Return how far nodes are from moving as parts of a rigid body, a scalar, 0 where they do.

    The regulariser E_reg of embedded deformation (Sumner, Schmid, Pauly, SIGGRAPH 2007): the square
    of where a node takes its neighbour less where that goes by itself, here in units of the
    distance between them; the mean over all pairs.

    Args:
        nodes: (M, 3) canonical places.
        transforms: (M, 19), see ``transforms``.
        near: (M, K) int32, the neighbours of each; itself, if among them, adds 0.
    """
    matrix, shift, _, _ = transforms.split(COLUMNS, dim=1)
    matrix, rows = matrix.unflatten(1, (3, 3)), near.flatten().long()
    offset = (matrix @ nodes[:, :, None])[:, :, 0] + shift
    places, goes = (t.index_select(0, rows).unflatten(0, near.shape) for t in (nodes, offset))
    apart = places - nodes[:, None]
    taken = apart @ matrix.transpose(1, 2) + offset[:, None]
    squares = apart.square().sum(dim=2)
    squares = torch.maximum(squares, _COINCIDENT * squares.mean())
    deviations = (taken - goes).square().sum(dim=2)
    return torch.mean(deviations / squares)


def skin(
    splats: Splats, nodes: Tensor, log_radii: Tensor, transforms: Tensor, near: Tensor
) -> Splats:
    """Return N splats where their nodes take them.

    Args:
        splats: N canonical splats.
        nodes: (M, 3) canonical places of the nodes.
        log_radii: (M,) logarithms of how far they reach [world units].
        transforms: (M, 19), see ``transforms``.
        near: (N, K) int32, the nodes of each splat.
    """
    stored = splats.means, splats.quats, splats.log_scales
    if has_kernels(*stored, nodes, log_radii, transforms):
        means, quats, log_scales = _Skin.apply(*stored, nodes, log_radii, transforms, near)
        return replace(splats, means=means, quats=quats, log_scales=log_scales)
    return skin_twin(splats, nodes, log_radii, transforms, near)


def skin_twin(
    splats: Splats, nodes: Tensor, log_radii: Tensor, transforms: Tensor, near: Tensor
) -> Splats:
    """Return what ``skin`` does, in plain torch, for any device and dtype."""
    rows = near.long()
    squares = (splats.means[:, None] - nodes[rows]).square().sum(dim=2)
    weights = torch.softmax(-0.5 * squares * torch.exp(-2 * log_radii)[rows], dim=1)
    blend = (weights[:, :, None] * transforms[rows]).sum(dim=1)
    matrix, shift, turn, growth = blend.split(COLUMNS, dim=1)
    moved = (matrix.unflatten(1, (3, 3)) @ splats.means[:, :, None])[:, :, 0] + shift
    return replace(
        splats,
        means=splats.means + moved,
        quats=splats.quats + _product(turn, splats.quats),
        log_scales=splats.log_scales + growth,
    )


def _product(first: Tensor, second: Tensor) -> Tensor:
    """Return the Hamilton products of quaternions (N, 4) wxyz."""
    a, b, c, d = first.unbind(1)
    w, x, y, z = second.unbind(1)
    parts = [
        a * w - b * x - c * y - d * z,
        a * x + b * w + c * z - d * y,
        a * y - b * z + c * w + d * x,
        a * z + b * y - c * x + d * w,
    ]
    return torch.stack(parts, dim=1)


class _Transform(Function):
    @staticmethod
    def forward(ctx: Any, nodes: Tensor, deformation: Tensor) -> Tensor:
        nodes, deformation = nodes.contiguous(), deformation.contiguous()
        made = nodes.new_empty(len(nodes), sum(COLUMNS))
        kernels.transform(*_arrays(nodes, deformation, made))
        ctx.save_for_backward(nodes, deformation, made)
        return made

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, given: Tensor) -> tuple[Tensor, Tensor]:
        nodes, deformation, made = ctx.saved_tensors
        gradients = torch.empty_like(nodes), torch.empty_like(deformation)
        kernels.transform_backward(
            *_arrays(nodes, deformation, made, given.contiguous(), *gradients)
        )
        return gradients


class _Skin(Function):
    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        log_scales: Tensor,
        nodes: Tensor,
        log_radii: Tensor,
        transforms: Tensor,
        near: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:
        means, quats, log_scales = (t.contiguous() for t in (means, quats, log_scales))
        sharpness = torch.exp(-2 * log_radii)
        by = [t.contiguous() for t in (nodes, sharpness, transforms, near)]
        weights = torch.empty(near.shape)
        moved = torch.empty_like(means), torch.empty_like(quats), torch.empty_like(log_scales)
        kernels.skin(*_arrays(means, quats, log_scales, *by, weights, *moved))
        ctx.save_for_backward(means, quats, *by, weights)
        return moved

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(ctx: Any, *given: Tensor) -> tuple[Tensor | None, ...]:
        *learnt, near, weights = ctx.saved_tensors
        d_moved, d_turned, d_scaled = (d.contiguous() for d in given)
        gradients = [torch.empty_like(tensor) for tensor in learnt]
        incoming = d_moved, d_turned, d_scaled
        kernels.skin_backward(*_arrays(*learnt, near, weights, *incoming, *gradients))
        d_means, d_quats, *others = gradients
        return d_means, d_quats, d_scaled, *others, None


def _arrays(*tensors: Tensor) -> Sequence[Any]:
    return [array(tensor) for tensor in tensors]
