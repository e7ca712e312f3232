"""No motion: the splats stay where they are (3DGS)."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Instant, Layer


@dataclass(frozen=True)
class Options:
    """Nothing to set."""


class Static(Layer):
    """The identity at every time."""

    constants = ()

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moment itself."""
        return moment


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Static:
    """Return the identity."""
    return Static()
