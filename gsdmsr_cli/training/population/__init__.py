"""Events that change the splats during a training, one file per event.

A preset lists its events by name, in the order in which they are asked after each step. An event is
a module of this package with ``Options``, a frozen dataclass of settings of its own, and
``start(options, preset) -> Event``. Events never import one another.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from gsdmsr_cli.ground import plugins
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.layer import options_of
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.scene.scene import View

if TYPE_CHECKING:
    from gsdmsr_cli.training.resizing import Population, Resize

KIND = "event"


class Tick(NamedTuple):
    """When an event is asked.

    Attributes:
        step: steps made, this one included.
        progress: in [0, 1], as the step began.
    """

    step: int
    progress: float


class Event(ABC):
    """Something that changes the splats now and then; mutable where it has a state of its own."""

    @abstractmethod
    def due(self, tick: Tick) -> bool:
        """Return whether it is to happen after this step; changes nothing."""

    @abstractmethod
    def apply(self, population: Population, tick: Tick) -> Resize | None:
        """Change the splats.

        Values of splats may be changed in place. Which splats there are, and in which order, must
        not be: that is what is returned, and then done to everything that has rows of splats.
        """

    def begin(self, views: Sequence[View]) -> str | None:
        """Learn of the train views, once; return what the user is to know of it, or None."""
        return None

    def state(self) -> dict[str, Any]:
        """Return what a resumed training needs of it, plain JSON."""
        return {}

    def restore(self, state: Mapping[str, Any]) -> None:  # noqa: B027  (most have no state)
        """Return to what ``state`` returned; it may lack what older versions did not have."""


def start_events(preset: Preset) -> dict[str, Event]:
    """Make the events that the preset lists, by name.

    Raises:
        UsageError: there is no such event, or it is listed twice, or an option is unknown or out
            of range.
    """
    started: dict[str, Event] = {}
    for settings in event_settings(preset.events):
        name = str(settings["name"])
        if name in started:
            raise UsageError(f"events names '{name}' twice; drop one")
        module: Any = plugins.load(__name__, name)
        started[name] = module.start(options_of(__name__, settings), preset)
    return started


def event_settings(
    listed: Sequence[str | Mapping[str, Any]],
) -> list[Mapping[str, Any]]:
    """Return the settings of each listed event; a mere name stands for its defaults."""
    return [{"name": entry} if isinstance(entry, str) else entry for entry in listed]
