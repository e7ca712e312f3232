"""Chooses the preset that suits a scene, for trainings that name none."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from statistics import median

from gsdmsr_cli.ground import plugins
from gsdmsr_cli.scene.scene import Scene

_RIG, _ONE_CAMERA = "n3v", "video"

_AT_ONCE = 3
"""As many views of one moment are those of a rig, whether or not its cameras move."""

_DIGITS = 6
"""Poses that agree to so many digits are those of one camera that stands still."""


@dataclass(frozen=True)
class Suited:
    """A preset that follows from the data.

    Attributes:
        name: of the preset.
        reason: what of the scene calls for it, to follow "since".
    """

    name: str
    reason: str


def suited_preset(scene: Scene) -> Suited:
    """Return the preset of the scene's format if that names one, else what its cameras call for.

    A scene that ``gsdmsr prepare`` has converted counts as one of the format that it had before.
    """
    for layout in filter(None, (scene.origin, scene.layout)):
        if layout in plugins.names("gsdmsr_cli.formats"):
            named = getattr(plugins.load("gsdmsr_cli.formats", layout), "PRESET", None)
            if named is not None:
                return Suited(named, f"the data has the layout {layout}")
    cameras = _still_cameras(scene)
    if cameras > 1:
        return Suited(_RIG, f"{cameras} cameras that stand still have filmed it")
    at_once = _views_at_once(scene)
    if at_once >= _AT_ONCE:
        return Suited(_RIG, f"{at_once} cameras see each moment")
    how = "moves" if cameras == 0 else "has filmed all of it"
    return Suited(_ONE_CAMERA, f"one camera {how}")


def _still_cameras(scene: Scene) -> int:
    """Return how many poses there are, or 0 where most views have one of their own."""
    poses = Counter(view.camera.world_to_camera.round(_DIGITS).tobytes() for view in scene.views)
    return len(poses) if 2 * len(poses) <= len(scene.views) else 0


def _views_at_once(scene: Scene) -> int:
    """Return the median number of views of a moment; 0 where there is only one moment."""
    moments = Counter(view.time for view in scene.views)
    return int(median(moments.values())) if len(moments) > 1 else 0
