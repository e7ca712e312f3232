"""A model in a form that anybody can play: splats, bodies that they follow, curves and lives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.moving.curves import Track

OF_BODIES = {"body/offset": 3, "body/turn": 4, "body/growth": 3}
"""Names of what changes of bodies, and the number of its channels."""

OF_SPLATS = {"splat/offset": 3, "splat/turn": 4, "splat/growth": 3, "splat/opacity": 1}
"""Names of what changes of splats, and the number of its channels; ``COLOURS`` beside them."""

COLOURS = "splat/sh"
"""Three channels for each coefficient of the harmonics change under this name."""


@dataclass(frozen=True, eq=False)
class Bodies:
    """What splats follow, as in ``ops.skin``.

    Attributes:
        points: (B, 3) canonical places [world units].
        log_radii: (B,) how far they reach; None where each splat follows one.
        body: (M,) int64, which one a splat follows; None where it follows the nearest.
        neighbours: how many a splat follows.
    """

    points: Tensor
    log_radii: Tensor | None
    body: Tensor | None
    neighbours: int


@dataclass(frozen=True, eq=False)
class Baked:
    """N splats, the first M of which move.

    Attributes:
        splats: canonical, with quaternions of unit length whose w is the largest.
        moving: M.
        times: at how many times curves are given; 1 where nothing moves.
        bodies: what the splats that move follow, or None.
        tracks: by the names above.
        lives: (M, 4) first and last time, and logarithms of how long a splat appears and vanishes;
            None where all are there always.
    """

    splats: Splats
    moving: int
    times: int
    bodies: Bodies | None = None
    tracks: Mapping[str, Track] = field(default_factory=dict)
    lives: Tensor | None = None
