"""Learning rates in closed form: where schedules begin, and in which units."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.options.preset import OptimizerOptions
from gsdmsr_cli.training.rates import learning_rates

OPTIONS = replace(OptimizerOptions(), means=(0.16, 0.0016), planes=(0.01, 0.0001), quats=(0.5, 0.5))
RADIUS = 3.0


def rates_at(progress: float, begins: float) -> dict[str, float]:
    named = ("means", "planes", "quats")
    parameters = [Parameter(f"a {name}", torch.zeros(2), rate=name) for name in named]
    parameters.append(Parameter("its own", torch.zeros(2), rate=(1.0, 0.01)))
    parameters.append(Parameter("a buffer", torch.zeros(2), rate=None))
    return learning_rates(parameters, OPTIONS, progress, begins, RADIUS)


@pytest.mark.parametrize(
    ("progress", "begins", "share"),
    [(0.0, 0.0, 1.0), (0.5, 0.0, 0.1), (1.0, 0.0, 0.01),
     (0.1, 0.4, 1.0), (0.4, 0.4, 1.0), (0.7, 0.4, 0.1), (0.55, 0.4, 0.1**0.5), (1.0, 0.4, 0.01)],
)  # fmt: skip
def test_schedules_fall_from_where_they_begin(progress: float, begins: float, share: float) -> None:
    """By 100 over what is left from there, a tenth half way; not at all before it."""
    found = rates_at(progress, begins)
    expected = {
        "a means": 0.16 * share * RADIUS,
        "a planes": 0.01 * share,
        "a quats": 0.5,
        "its own": share,
    }
    assert found == pytest.approx(expected, rel=1e-12)


def test_a_training_that_is_static_to_its_end_keeps_its_first_rates() -> None:
    assert rates_at(1.0, 1.0)["a planes"] == pytest.approx(0.01, rel=1e-12)
