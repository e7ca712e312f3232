"""Layers by themselves, for tests."""

from __future__ import annotations

from typing import Any

import torch
from kernel_checks import generator
from motion_checks import FACTS, disturbed, splats_of, started

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model import layers
from gsdmsr_cli.model.layer import Layer, start_layer
from gsdmsr_cli.model.model import Model


def started_layer(name: str, count: int = 1, /, **options: Any) -> Layer:
    """Return the layer as training starts it with so many splats, in a scene of ``FACTS``."""
    settings = {"name": name, **options}
    return start_layer(layers.__name__, settings, FACTS, splats_of(count), generator())


def with_and_without(layer: Layer, count: int, moving: int) -> tuple[Splats, Splats]:
    """Return what control points make of splats, the first of which move, with a layer and without.

    The layer holds rows of those that move.
    """
    splats = splats_of(count)
    motion = disturbed(started("control_points", moving, count=4, neighbours=2))
    models = (
        Model(splats, {"motion": motion} | more, moving) for more in ({"layers.0": layer}, {})
    )
    with torch.no_grad():
        changed, plain = (model.at(model.instant(0.3)).splats for model in models)
    return changed, plain
