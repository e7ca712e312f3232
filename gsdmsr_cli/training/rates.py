"""The learning rate of every tensor of a model at a point of the training."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.options.preset import OptimizerOptions
from gsdmsr_cli.training.schedule import log_linear

_RADII = "means"
"""The rate that is in units of the scene's radius."""

NAMED = tuple(field.name for field in fields(OptimizerOptions) if field.name != "sh_rest")
"""Names that ``Parameter.rate`` may have."""


def learning_rates(
    parameters: Sequence[Parameter],
    options: OptimizerOptions,
    progress: float,
    begins: float,
    radius: float,
) -> dict[str, float]:
    """Return the learning rate of each trained parameter by its name.

    Args:
        parameters: of a model.
        options: the preset's rates.
        progress: in [0, 1].
        begins: progress at which the schedules begin.
        radius: of the scene [world units].
    """
    p = (progress - begins) / (1 - begins) if begins < 1 else 0.0
    named = {name: log_linear(getattr(options, name), p) for name in NAMED}
    named[_RADII] *= radius
    return {
        one.name: named[one.rate] if isinstance(one.rate, str) else log_linear(one.rate, p)
        for one in parameters
        if one.rate is not None
    }
