"""A camera path that stays at one view while time runs."""

from __future__ import annotations

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.paths._views import find_view
from gsdmsr_cli.scene.film import PathOptions, Shot, over_time
from gsdmsr_cli.scene.scene import Scene

TAKES = frozenset({"frames", "views"})
FRAMES = 120


def shots(scene: Scene, options: PathOptions) -> list[Shot]:
    """Return the camera of the one view that is named, while time goes from 0 to 1.

    Raises:
        UsageError: not one view is named, or there is no such view.
    """
    if len(options.views) != 1:
        raise UsageError(
            f"--path still stands at one view; found {len(options.views)} --view, give one"
        )
    camera = find_view(scene, options.views[0]).camera
    return over_time([camera] * (options.frames or FRAMES))
