"""A rig of cameras that stand still: the demo's scene, in D-NeRF layout, seen by all at once."""

from __future__ import annotations

import json
import math
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np
from datasets import write_picture

from gsdmsr_cli.demo.solids import Ball
from gsdmsr_cli.demo.synthetic import CAMERA_ANGLE_X, Placed, camera_on_dome, draw, solids_at
from gsdmsr_cli.scene.camera import Camera

VISITOR = (0.35, 0.35, 0.0), 0.35
"""Centre and radius of the ball that comes in [world units]."""


def cameras_of(count: int, size: int) -> list[Camera]:
    """Return cameras all round the scene, at two heights in turn."""
    return [
        camera_on_dome(2 * math.pi * i / count, 0.35 + 0.5 * (i % 2), size) for i in range(count)
    ]


def write_rig(
    folder: Path,
    size: int = 32,
    cameras: int = 6,
    moments: int = 4,
    span: float = 0.05,
    missing: Collection[tuple[int, int]] = (),
    visitor: int | None = None,
) -> Path:
    """Write a scene of which a part of the demo's motion is seen.

    Args:
        folder: to write.
        size: of the pictures [px].
        cameras: of the train split; one more, between two of them, is val and test.
        moments: evenly spaced.
        span: the demo's time at the last of them.
        missing: pairs of a moment and a train camera of which there is no picture.
        visitor: moment from which on a second ball stands in the scene, or None.
    """
    splits = {"train": cameras_of(cameras, size)}
    splits |= {key: [camera_on_dome(math.pi / cameras, 0.6, size)] for key in ("val", "test")}
    for split, own in splits.items():
        frames: list[dict[str, Any]] = []
        for moment in range(moments):
            time = moment / max(moments - 1, 1)
            solids = solids_at(span * time)
            if visitor is not None and moment >= visitor:
                solids.append(Placed(Ball(VISITOR[1]), np.eye(3), np.array(VISITOR[0])))
            for i, camera in enumerate(own):
                if split == "train" and (moment, i) in missing:
                    continue
                name = f"{split}/c{i}_{moment:03d}"
                write_picture(folder / f"{name}.png", draw(solids, camera))
                frames.append(
                    {"file_path": f"./{name}", "time": time, "transform_matrix": _pose(camera)}
                )
        document = {"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(document))
    return folder


def _pose(camera: Camera) -> list[list[float]]:
    """Return the camera-to-world matrix in OpenGL axes."""
    matrix = np.linalg.inv(camera.world_to_camera) @ np.diag([1.0, -1.0, -1.0, 1.0])
    found: list[list[float]] = matrix.tolist()
    return found
