"""A smooth camera path through given views, each at its moment."""

from __future__ import annotations

import numpy as np

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.paths._smooth import Key, interpolate, lengths
from gsdmsr_cli.paths._views import find_view
from gsdmsr_cli.scene.film import PathOptions, Shot
from gsdmsr_cli.scene.scene import Scene

TAKES = frozenset({"frames", "views"})
FRAMES = 120


def shots(scene: Scene, options: PathOptions) -> list[Shot]:
    """Return the path through the named views, at an even speed.

    Raises:
        UsageError: fewer than two views are named, or there is no such view.
    """
    if len(options.views) < 2:
        raise UsageError(
            f"--path interpolate goes through two or more views; found {len(options.views)} "
            "--view, give them in order"
        )
    views = [find_view(scene, name) for name in options.views]
    keys = [Key(view.camera, view.time) for view in views]
    knots = np.concatenate([[0.0], np.cumsum(lengths(keys))])
    return interpolate(keys, knots, np.linspace(0, knots[-1], options.frames or FRAMES))
