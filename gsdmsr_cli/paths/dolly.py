"""A camera path straight ahead, from a view towards the middle of the scene."""

from __future__ import annotations

from dataclasses import replace

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.paths._views import find_view
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.film import PathOptions, Shot, moments, over_time
from gsdmsr_cli.scene.scene import Scene

TAKES = frozenset({"frames", "views"})
FRAMES = 120
REACH = 0.5
"""Share of the distance to the middle of the scene that the camera moves."""


def shots(scene: Scene, options: PathOptions) -> list[Shot]:
    """Return the slide from the named view, or the first train view, while time goes on.

    Raises:
        UsageError: more than one view is named, or there is no such view.
        DataError: none is named and there are no train views.
    """
    if len(options.views) > 1:
        raise UsageError(f"--path dolly begins at one view; found {len(options.views)} --view")
    view = find_view(scene, options.views[0]) if options.views else scene.split("train")[0]
    return over_time(dolly(view.camera, scene.bound, options.frames or FRAMES))


def dolly(camera: Camera, least: float, count: int) -> list[Camera]:
    """Return ``count`` cameras along the line of sight, slow at both ends (smoothstep).

    Args:
        camera: where it begins; the way is ``REACH`` of its distance from the world's origin along
            the line of sight.
        least: the way is as if the origin lay at least so far ahead [world units].
        count: number of cameras.
    """
    # where the origin lies behind the camera, or close to it, there is no way towards it
    way = REACH * max(float(camera.translation[2]), least)
    return [_ahead(camera, way * u * u * (3 - 2 * u)) for u in moments(count)]


def _ahead(camera: Camera, way: float) -> Camera:
    pose = camera.world_to_camera.copy()
    pose[2, 3] -= way
    return replace(camera, world_to_camera=pose)
