"""The file of a model at once, coded finely without measuring what that loses: for a look at it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gsdmsr_cli.model.joined import Joined
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.moving.baking import bake
from gsdmsr_cli.moving.coding import coded, described, steps_named
from gsdmsr_cli.moving.container import to_bytes
from gsdmsr_cli.moving.parts import packed

MOST_TIMES = 33
"""At which a model is looked at, or that of each segment of time."""


def quick_file(model: Model, frames: int, bound: float, further: Mapping[str, Any]) -> bytes:
    """Return the file of a model.

    Args:
        model: see ``bake``.
        frames: number of distinct times at which it has been trained.
        bound: half edge of the cube that holds the scene [world units].
        further: what else its header is to say.

    Raises:
        DataError: a splat holds NaN or infinity.
    """
    segments = len(model.segments) if isinstance(model, Joined) else 1
    baked = bake(model, min(frames, MOST_TIMES * segments))
    parts = [packed(table) for table in coded(baked, steps_named(baked), bound)]
    return to_bytes({**described(baked), **further}, parts)
