"""What ``gsdmsr info`` finds at a path: what it is, facts, and what is wrong with it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Found:
    """What lies somewhere.

    Attributes:
        kind: what it is, such as "scene".
        facts: what is known of it, plain JSON, in the order in which it is shown.
        problems: a sentence for each reason why it cannot be used as it is.
    """

    kind: str
    facts: Mapping[str, Any]
    problems: tuple[str, ...] = field(default=())

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong with it."""
        return not self.problems
