"""What one command asks for, so that the same command is known again after a kill at its end."""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from gsdmsr_cli.capture.options import Options
from gsdmsr_cli.capture.prepare import Masks
from gsdmsr_cli.capture.stages import NOTE, Stages, digest
from gsdmsr_cli.capture.write import TIMINGS
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import read_json, write_json

_ID = "publication"


@dataclass(frozen=True)
class Order:
    """A command: its input, what that is taken for, the masks, and the options.

    Attributes:
        standing: tells the model of what stands still from others, where masks are of one.
    """

    given: Path
    kind: str | None
    masks: Masks | None
    options: Options
    standing: str | None = None

    def announce(self, stages: Stages) -> dict[str, str]:
        """Note beside the stages that the scene is about to be moved to its place.

        Returns what the scene itself is to say of that.
        """
        publication = {_ID: uuid.uuid4().hex}
        write_json(stages.root / NOTE, {"order": self._digest()} | publication)
        return publication

    def conclude(self, stages: Stages) -> None:
        """Forget what was announced: the scene is where it belongs."""
        (stages.root / NOTE).unlink(missing_ok=True)

    def is_published(self, place: Path, stages: Stages) -> bool:
        """Return whether the scene there is what this command had moved before it was killed."""
        try:
            note, timings = read_json(stages.root / NOTE), read_json(place / TIMINGS)
        except DataError:
            return False
        same = note.get(_ID) is not None and note.get(_ID) == timings.get(_ID)
        return same and note.get("order") == self._digest()

    def _digest(self) -> str:
        masks = None if self.masks is None else [str(self.masks.folder), self.masks.inverted]
        about = {"kind": self.kind, "masks": masks, "options": asdict(self.options)}
        if self.standing is not None:
            about["standing"] = self.standing
        return digest({"given": list(_seen(self.given)), **about})


def _seen(given: Path) -> Iterator[tuple[str, int, int]]:
    """Yield names, sizes and times of what is given, which tell whether it is still the same."""
    inside = sorted(given.rglob("*")) if given.is_dir() else []
    for path in (given.resolve(), *inside):
        stat = path.stat()
        yield str(path), stat.st_size, stat.st_mtime_ns
