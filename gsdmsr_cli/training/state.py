"""Saves and restores the parts of a training as named tensors, each part under a prefix."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from torch import Tensor

from gsdmsr_cli.model.parameter import below


class Part(Protocol):
    """Something that a training keeps beside its model."""

    def tensors(self) -> dict[str, Tensor]:
        """Return the state by name."""

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Return to what ``tensors`` returned."""


def gather(parts: Mapping[str, Part]) -> dict[str, Tensor]:
    """Return the tensors of all parts; the keys are their prefixes."""
    return {p + name: t for p, part in parts.items() for name, t in part.tensors().items()}


def scatter(parts: Mapping[str, Part], tensors: Mapping[str, Tensor]) -> None:
    """Restore all parts from what ``gather`` returned, perhaps among others."""
    for prefix, part in parts.items():
        part.restore(below(prefix, tensors))
