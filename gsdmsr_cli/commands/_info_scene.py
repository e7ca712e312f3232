"""Looks at a scene in any layout, for ``gsdmsr info``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gsdmsr_cli.commands._found import Found
from gsdmsr_cli.formats import layout_of, needs_preparing, read_scene, suited_preset
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.scene import SPLITS, Scene


def scene_found(folder: Path) -> Found:
    """Return what a scene is, without writing into it; every file but pixels is checked."""
    layout = layout_of(folder)
    if needs_preparing(folder):
        note = "its videos are decoded by the first command that reads it"
        return Found("scene", {"layout": layout, "frames": note})
    try:
        scene = read_scene(folder)
    except DataError as error:
        return Found("scene", {"layout": layout}, (str(error),))
    return Found("scene", {"layout": layout, **facts_of(scene)})


def facts_of(scene: Scene) -> dict[str, Any]:
    """Return the numbers of a scene, plain JSON."""
    counts = {split: sum(view.split == split for view in scene.views) for split in SPLITS}
    camera, times = scene.views[0].camera, {view.time for view in scene.views}
    suited = suited_preset(scene)
    signals = sorted({name for view in scene.views for name in view.signals})
    return {
        "made_from": scene.origin,
        "pictures": counts,
        "size": [camera.width, camera.height],
        "lens": "with distortion" if any(view.lens for view in scene.views) else "pinhole",
        "masks": signals,
        "moments": len(times),
        "times": [min(times), max(times)],
        "duration_s": scene.duration,
        "bound": scene.bound,
        "radius": scene.radius,
        "points": len(scene.points),
        "preset": suited.name,
        "preset_reason": suited.reason,
        "fingerprint": scene.fingerprint,
    }
