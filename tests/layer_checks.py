"""Layers by themselves, for tests."""

from __future__ import annotations

from typing import Any

from kernel_checks import generator
from motion_checks import FACTS, splats_of

from gsdmsr_cli.model import layers
from gsdmsr_cli.model.layer import Layer, start_layer


def started_layer(name: str, count: int = 1, /, **options: Any) -> Layer:
    """Return the layer as training starts it with so many splats, in a scene of ``FACTS``."""
    settings = {"name": name, **options}
    return start_layer(layers.__name__, settings, FACTS, splats_of(count), generator())
