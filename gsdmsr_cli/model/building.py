"""Makes a model of splats and the layers that a preset names, or of what has been saved."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.model import layers as further
from gsdmsr_cli.model import motion as motions
from gsdmsr_cli.model.layer import Facts, Layer, options_of, start_layer
from gsdmsr_cli.model.model import FURTHER, MOTION, MOVING, STORED_AS, Model
from gsdmsr_cli.model.parameter import below
from gsdmsr_cli.scene.camera import Camera


def start_model(
    splats: Splats,
    motion: Mapping[str, Any],
    layers: Sequence[Mapping[str, Any]],
    facts: Facts,
    generator: torch.Generator,
    moving: int | None = None,
    precision: str = "float32",
    times: Tensor | None = None,
    views: Sequence[tuple[Camera, float]] = (),
) -> Model:
    """Make a model of splats whose layers begin anew.

    Args:
        splats: N canonical splats, those that move first.
        motion: name and options of the motion.
        layers: of the further layers, in their order.
        facts: of the scene.
        generator: source of random choices.
        moving: how many splats move; all if None.
        precision: see ``Model``.
        times: (N,) at which the splats were seen, see ``Layer.begin_at``.
        views: cameras and times of the train views, see ``Layer.begin_with``.

    Raises:
        UsageError: there is no such motion or layer, or an option is unknown or out of range.
    """
    begun: dict[str, Layer] = {}
    for key, package, settings in _named(motion, layers):
        begun[key] = start_layer(package, settings, facts, splats, generator)
        if times is not None:
            begun[key].begin_at(times)
        if views:
            begun[key].begin_with(views)
    return Model(splats, begun, moving, precision)


def check_layers(motion: Mapping[str, Any], layers: Sequence[Mapping[str, Any]]) -> None:
    """Raise UsageError if ``start_model`` would for these settings."""
    for _, package, settings in _named(motion, layers):
        options_of(package, settings)


def _named(
    motion: Mapping[str, Any], layers: Sequence[Mapping[str, Any]]
) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Return the name, the package and the settings of every layer.

    Raises:
        UsageError: a layer is named twice.
    """
    yield MOTION, motions.__name__, motion
    names: set[str] = set()
    for settings in layers:
        name = str(settings.get("name", ""))
        if name in names:
            raise UsageError(f"layers names '{name}' twice; drop one")
        names.add(name)
        yield FURTHER + name, further.__name__, settings


def load_model(
    tensors: Mapping[str, Tensor],
    motion: Mapping[str, Any],
    layers: Sequence[Mapping[str, Any]],
    facts: Facts,
    progress: float,
    precision: str = "float32",
) -> Model:
    """Rebuild a model from its saved tensors, on the CPU, wherever these lie.

    Args:
        tensors: what ``Model.tensors`` returned, and ``MOVING`` if not all move, perhaps among
            others. Their shapes count, not those that the settings would begin with.
        motion, layers, facts, precision: see ``start_model``.
        progress: how far training had come.

    Raises:
        DataError: a tensor is missing, or does not fit to the others or to the settings.
    """
    tensors = {name: tensor.cpu() for name, tensor in tensors.items()}  # where layers begin
    try:
        splats = Splats(**below(STORED_AS, tensors))
    except (TypeError, ValueError) as error:
        raise DataError(f"the checkpoint's splats cannot be used: {error}") from error
    moving = int(tensors[MOVING]) if MOVING in tensors else len(splats)
    if not 0 <= moving <= len(splats):
        raise DataError(f"the checkpoint says that {moving} of {len(splats)} splats move")
    model = start_model(splats, motion, layers, facts, torch.Generator(), moving, precision)
    model.restore(tensors)
    model.advance(progress)
    return model
