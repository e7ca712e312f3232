"""Leaves out of the loss what does not fit the other views, such as people who walk by.

The robust mask of UW-GS (Wang et al., WACV 2025) after RobustNeRF (Sabour et al., CVPR 2023): what
has a large error over an area is left out, single pixels and lines, where detail is not yet learnt,
are not. The threshold is a quantile of the picture's own errors rather than of those seen last, so
that it follows from the step alone.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

PATCH, STRIDE = 16, 8
"""Sides of the patches that count as a whole, and the way from one to the next [px]."""

MOST = 0.5
"""Share of a neighbourhood that fits above which the rest of it is taken to fit as well."""


@torch.no_grad()
def inliers(rgb: Tensor, target: Tensor, share: float) -> Tensor:
    """Return which pixels are to count, (H, W) bool.

    These are the share with the least errors, those of which most neighbours are among them, and
    those in a patch of which most pixels are.

    Args:
        rgb: (H, W, 3) drawn picture.
        target: (3, H, W) uint8 picture.
        share: of the pixels whose errors are taken to be normal, above 0, up to 1.
    """
    errors = (rgb - target.permute(1, 2, 0).to(rgb) / 255).abs().mean(dim=2)
    count = max(1, round(share * errors.numel()))
    fits = errors <= errors.flatten().kthvalue(count).values
    near = _mean_of_neighbours(fits.to(rgb)) > MOST
    return fits | near | _in_patches(fits.to(rgb))


def _mean_of_neighbours(values: Tensor) -> Tensor:
    """Return the means over 3 x 3 pixels, as far as there are any, (H, W)."""
    means: Tensor = avg_pool2d(values[None, None], 3, 1, 1, count_include_pad=False)
    return means[0, 0]


def _in_patches(values: Tensor) -> Tensor:
    """Return which pixels lie in a patch whose mean is more than ``MOST``, (H, W) bool."""
    height, width = values.shape
    aside = PATCH - STRIDE
    rows, columns = (-(-side // STRIDE) * STRIDE for side in (height, width))
    grown = (aside, columns - width + aside, aside, rows - height + aside)
    both = torch.stack([values, torch.ones_like(values)])[:, None]
    sums = avg_pool2d(pad(both, grown), PATCH, STRIDE)[:, 0]  # pixels beyond the edge do not count
    most = (sums[0] > MOST * sums[1]).to(values)[None, None]
    # a block of STRIDE pixels lies in the patches that begin at it and a stride before it
    blocks = torch.nn.functional.max_pool2d(most, PATCH // STRIDE, 1)[0, 0] > 0
    pixels = blocks.repeat_interleave(STRIDE, 0).repeat_interleave(STRIDE, 1)
    return pixels[:height, :width]
