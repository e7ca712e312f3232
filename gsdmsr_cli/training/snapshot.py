"""A training as a checkpoint, and back: the tensors of its parts, and the rest as plain JSON."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

import torch
from torch import Tensor

from gsdmsr_cli.model.model import MOVING, Model
from gsdmsr_cli.model.parameter import below
from gsdmsr_cli.runs.checkpoints import Checkpoint
from gsdmsr_cli.training.averaging import Average
from gsdmsr_cli.training.gradients.tiles import TileSampler
from gsdmsr_cli.training.optimizer import Adam
from gsdmsr_cli.training.population import Event
from gsdmsr_cli.training.resizing import Population
from gsdmsr_cli.training.saliency import Saliency
from gsdmsr_cli.training.schedule import Clock
from gsdmsr_cli.training.state import Part, gather, scatter

_LAST = "last."
"""Before the names of the model's last values, where a checkpoint's model is an average."""


class Training(Protocol):
    """What a checkpoint is taken of: see ``Trainer``."""

    population: Population
    optimizer: Adam
    saliency: Saliency
    tiles: TileSampler
    events: dict[str, Event]
    generator: torch.Generator
    queue: list[int]
    clock: Clock
    device: torch.device

    def populate(self, model: Model) -> Population:
        """Return a model with what is kept for each of its splats, which begins anew."""

    def load(self, tensors: Mapping[str, Tensor], progress: float) -> Model:
        """Return the model of saved tensors, on the device."""


def take(training: Training) -> Checkpoint:
    """Return the result so far and everything needed to go on from here."""
    model, average = training.population.model, training.population.average
    tensors = dict(model.tensors())
    if average.count:
        tensors = {_LAST + name: tensor for name, tensor in tensors.items()}
        tensors |= average.tensors
    if model.moving < len(model.splats):
        tensors[MOVING] = torch.tensor(model.moving)
    tensors |= gather(_parts(training))
    tensors["generator"] = training.generator.get_state()
    state = {
        "queue": training.queue,
        "events": {name: event.state() for name, event in training.events.items()},
        "moving": training.population.moving,
        "dropped": training.population.dropped,
        "adam_steps": training.optimizer.steps,
        "adam_restarts": training.optimizer.restarts,
        "averaged": average.count,
    }
    clock = training.clock
    return Checkpoint(clock.step, clock.overall, clock.elapsed, tensors, state)


def restore(training: Training, checkpoint: Checkpoint) -> None:
    """Let a training go on from a checkpoint of the same preset and scene."""
    state = checkpoint.state
    tensors = {
        name: tensor.to(_device_of(training, name)) for name, tensor in checkpoint.tensors.items()
    }
    average = Average()
    average.count = int(state["averaged"])
    last = dict(tensors)
    if average.count:
        last = below(_LAST, tensors)
        average.tensors = {name: tensors[name] for name in last}
        if MOVING in tensors:
            last[MOVING] = tensors[MOVING]
    training.population = training.populate(training.load(last, checkpoint.progress))
    training.population.average = average
    training.population.moving = bool(state["moving"])
    training.population.dropped = int(state["dropped"])
    scatter(_parts(training), tensors)
    optimizer = training.optimizer
    optimizer.steps = {name: int(count) for name, count in state["adam_steps"].items()}
    optimizer.restarts = {name: int(count) for name, count in state["adam_restarts"].items()}
    training.generator.set_state(tensors["generator"])
    training.queue = list(state["queue"])
    for name, event in training.events.items():
        if name in state["events"]:
            event.restore(state["events"][name])
    training.clock.step, training.clock.before = checkpoint.step, checkpoint.elapsed


def _parts(training: Training) -> dict[str, Part]:
    """Return what is kept beside the model, by the prefix of its tensors in a checkpoint."""
    return {
        "adam.": training.optimizer,
        "density.": training.population.statistics,
        "saliency.": training.saliency,
        "tiles.": training.tiles,
    }


def _device_of(training: Training, name: str) -> torch.device:
    """Return the device of a checkpoint's tensor: random state and tiles stay on the CPU."""
    on_cpu = name.startswith(("generator", "tiles."))
    return torch.device("cpu") if on_cpu else training.device
