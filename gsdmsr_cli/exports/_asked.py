"""What may be asked of every export: axes, units, harmonics, which splats, what may be lost."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Literal

from gsdmsr_cli.options.strict import Located, require

Axes = Literal["scene", "y-up", "z-up", "opencv"]


@dataclass(frozen=True)
class Asked:
    """Settings of every export.

    Attributes:
        axes: of the file: the scene's as they are, or those into which a scene with z up is
            turned; what the format prescribes if None.
        scale: units of the file in one of the scene.
        sh_degree: harmonics of higher degrees are left out; none if None.
        min_opacity: splats that are less opaque are left out, in [0, 1].
        lossy: whether what the format cannot carry may be missing.
    """

    axes: Axes | None = None
    scale: float = 1.0
    sh_degree: int | None = None
    min_opacity: float = 0.0
    lossy: bool = False

    def __post_init__(self) -> None:
        require(self, "scale", self.scale > 0, "more than 0")
        in_range = self.sh_degree is None or 0 <= self.sh_degree <= 3
        require(self, "sh_degree", in_range, "0 to 3")
        require(self, "min_opacity", 0 <= self.min_opacity <= 1, "0 to 1")


NAMES = tuple(field.name for field in dataclasses.fields(Asked))


def taken_apart(settings: Located) -> tuple[Located, Located]:
    """Return the settings that every export has, and the others, which are the format's."""
    return settings.without(*(set(settings) - set(NAMES))), settings.without(*NAMES)
