"""A trained scene: canonical splats and the motion that moves them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from gsdmsr_cli.errors import DataError
from gsdmsr_cli.motion import Facts, Motion, start_motion
from gsdmsr_cli.splats import NAMES, Splats

STORED_AS = "splats."
MOVED_BY = "motion."


class Model:
    """N canonical splats and their motion; mutable, since training changes both."""

    def __init__(self, splats: Splats, motion: Motion) -> None:
        self.splats = splats.map(lambda t: torch.nn.Parameter(t.detach().contiguous()))
        self.motion = motion

    def at(self, time: float) -> Splats:
        """Return the splats at ``time`` in [0, 1]."""
        return self.motion.at(self.splats, time)

    def take(self, rows: Tensor) -> None:
        """Make row i what row ``rows[i]`` was; rows is (M,) int64.

        The one resize verb: clone, split, prune and reorder. For every motion
        ``take`` then ``at`` equals ``at`` then ``take``.
        """
        self.splats = self.splats.detach().take(rows).map(torch.nn.Parameter)
        self.motion.take(rows)

    def tensors(self) -> dict[str, Tensor]:
        """Return everything that is trained and saved, by name."""
        named = {STORED_AS + name: tensor for name, tensor in self.splats.tensors().items()}
        return named | {MOVED_BY + name: t for name, t in self.motion.tensors().items()}

    def per_splat(self) -> list[str]:
        """Return the names of all tensors with one row per splat."""
        groups, held = self.motion.groups(), ("embeddings", *NAMES)
        return [STORED_AS + name for name in NAMES] + [
            MOVED_BY + name for name, group in groups.items() if group in held
        ]


def load_model(
    tensors: Mapping[str, Tensor], settings: Mapping[str, Any], facts: Facts, progress: float
) -> Model:
    """Rebuild a model from its saved tensors.

    Args:
        tensors: what ``Model.tensors`` returned, perhaps among others.
        settings: the motion's name and options.
        facts: the facts the motion was started with.
        progress: how far training had come.

    Raises:
        DataError: a tensor is missing or has another shape than the settings ask for.
    """
    stored = {k: v for k, v in tensors.items() if k.startswith(STORED_AS)}
    try:
        splats = Splats(**{name.removeprefix(STORED_AS): t for name, t in stored.items()})
    except (TypeError, ValueError) as error:
        raise DataError(f"the checkpoint's splats cannot be used: {error}") from error
    model = Model(splats, start_motion(settings, facts, len(splats), torch.Generator()))
    model.motion.advance(progress)
    with torch.no_grad():
        for name, tensor in model.motion.tensors().items():
            saved = tensors.get(MOVED_BY + name)
            if saved is None or saved.shape != tensor.shape:
                found = "nothing" if saved is None else f"shape {tuple(saved.shape)}"
                raise DataError(
                    f"the checkpoint holds {found} for '{name}', not {tuple(tensor.shape)}"
                )
            tensor.copy_(saved)
    return model
