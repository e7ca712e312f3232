"""L_smooth of GS-DMSR: what a decoder says of places close to each other is much the same.

A finite difference in place of the method's |grad_x phi|^2, at some of the splats.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats

ROWS = 1024
"""Splats that it is evaluated at in a step."""


def some_twice(
    splats: Splats, own: Tensor | None, reach: float, generator: torch.Generator
) -> tuple[Splats, Tensor | None]:
    """Return ``ROWS`` splats where they are, then the same ones beside; no gradient to places.

    Args:
        splats: to choose from.
        own: features (N, K) of them; those of the chosen ones are returned, twice as well.
        reach: how far beside, as a standard deviation [world units].
        generator: source of the choice and of the offsets.
    """
    rows = torch.randint(len(splats), (ROWS,), generator=generator).to(splats.means.device)
    places = splats.means.detach()[rows]
    beside = places + reach * torch.randn(places.shape, generator=generator).to(places)
    both = replace(splats.take(rows.repeat(2)), means=torch.cat([places, beside]))
    return both, None if own is None else own[rows].repeat(2, 1)


def roughness(outputs: Tensor) -> Tensor:
    """Return the mean squared difference between both halves of the rows (2M, K), a scalar."""
    here, there = outputs.chunk(2)
    return (here - there).square().sum(dim=1).mean()
