"""The constants of splatting, for every engine; as in 3DGS (Kerbl et al. 2023) unless said."""

from __future__ import annotations

NEAR = 0.2
"""Splats whose centre has camera z at or below this [world units] are not drawn (3DGS)."""

DILATION = 0.3
"""Variance added to both axes of a splat's screen covariance [px^2], a low-pass (3DGS)."""

ALPHA_MIN = 1.0 / 255.0
"""A splat does not touch a pixel where its alpha falls below this (3DGS)."""

ALPHA_MAX = 0.999
"""Alpha saturates here; a saturated pixel passes no gradient to the splat's shape and opacity."""

TRANSMITTANCE_STOP = 1e-4
"""A pixel is finished AFTER its transmittance falls below this. Engines may go on blending it as
long as others of the same tile are unfinished; the difference is below this value."""

FRUSTUM_MARGIN = 1.3
"""The projection's Jacobian clamps x/z and y/z to this multiple of the half image (3DGS)."""

TILE = 16
"""Edge of a tile [px] in engines that have tiles."""


def tile_grid(width: int, height: int) -> tuple[int, int]:
    """Return the rows and columns of tiles that cover a picture; tiles are numbered row by row."""
    return -(-height // TILE), -(-width // TILE)
