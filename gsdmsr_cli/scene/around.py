"""Finds whether cameras stand around the scene, so that what they see lies between them."""

from __future__ import annotations

import numpy as np

from gsdmsr_cli.scene.scene import Scene


def cameras_stand_around(scene: Scene) -> bool:
    """Return whether two train cameras look in directions more than a right angle apart.

    Where they do, neighbours among them are far apart, and depths at which they agree by chance are
    many: splats there become fog in front of the cameras.
    """
    ways = np.stack([view.camera.rotation[2] for view in scene.split("train")])
    ways = np.unique(ways.round(6), axis=0)  # a rig's cameras come again at every moment
    return any((ways[i:] @ way).min() < 0 for i, way in enumerate(ways))
