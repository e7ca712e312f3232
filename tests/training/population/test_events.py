"""Which events a training has, and when they are due."""

from __future__ import annotations

import pytest

from gsdmsr_cli.ground import plugins
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.options.preset import EVENTS, Preset, load_preset
from gsdmsr_cli.training import population
from gsdmsr_cli.training.population import Tick, start_events


def preset_of(*options: str) -> Preset:
    return load_preset("dnerf", None, options)


def test_a_preset_has_the_events_of_every_training_unless_it_says_otherwise() -> None:
    assert list(start_events(preset_of())) == list(EVENTS)
    assert set(EVENTS) < set(plugins.names(population.__name__))


def test_events_are_asked_in_the_order_of_the_list() -> None:
    listed = start_events(preset_of("events=[thinning, {name: density}]"))
    assert list(listed) == ["thinning", "density"]


@pytest.mark.parametrize(
    ("listed", "found"),
    [
        ("[densty]", "'densty'; did you mean 'density'"),
        ("[density, {name: density}]", "names 'density' twice; drop one"),
        ("[{name: density, every: 3}]", "unknown key 'every'"),
    ],
)
def test_events_that_cannot_be_are_told(listed: str, found: str) -> None:
    with pytest.raises(UsageError, match=found):
        start_events(preset_of(f"events={listed}"))


def due(name: str, *options: str) -> list[int]:
    """Return after which of 100 steps an event that is never applied is due."""
    event = start_events(preset_of(*options))[name]
    return [step for step in range(1, 101) if event.due(Tick(step, (step - 1) / 100))]


def test_events_are_due_when_the_preset_says_so() -> None:
    growing = "density.start=20", "density.every=10", "density.until=0.5"
    assert due("density", *growing) == [20, 30, 40, 50]
    assert due("opacity_reset", "density.reset_at=[0.97]") == [98, 99, 100]
    assert due("opacity_reset", "density.reset_at=[]") == []
    assert due("thinning", "density.thin_at=[0.98, 0.99]") == [99, 100]
    still = "saliency.still_from=0.3", "saliency.still_every=20", "training.average_from=0.9"
    assert due("stillness", *still, "density.until=0.5") == [60, 80]
    assert due("stillness", *still, "density.until=0.1") == [40, 60, 80]


def test_once_nothing_grows_any_more_splats_are_pruned_every_500_steps() -> None:
    event = start_events(preset_of("density.until=0.5", "density.start=700"))["density"]
    asked = [499, 500, 501, 999, 1000, 1001, 1500]
    assert [step for step in asked if event.due(Tick(step, 0.6))] == [1000, 1500]


def test_what_has_happened_is_restored() -> None:
    reset = start_events(preset_of("density.reset_at=[0.1, 0.5]"))["opacity_reset"]
    reset.restore({"count": 1})
    assert not reset.due(Tick(2, 0.3)) and reset.due(Tick(2, 0.5))
    assert reset.state() == {"count": 1}
