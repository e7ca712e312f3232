"""What exports that are played want to know of a run's scene: views to compare in, a first view."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsdmsr_cli import raster
from gsdmsr_cli.drawing.judging import Judge
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground import say
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.options.preset import BACKGROUNDS
from gsdmsr_cli.paths._around import common_up
from gsdmsr_cli.runs.run import Run
from gsdmsr_cli.scene.camera import Camera, look_at
from gsdmsr_cli.scene.neighbours import neighbours
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene, View

VIEWS = 16
"""In which models are compared, evenly spaced in time."""

CIRCLE_SIZE, CIRCLE_VIEW = 400, math.radians(40)
"""Edge [px] and field of view of cameras on a circle, where the data and its own are not there."""

FRAMES_A_SECOND = 25
"""Where the data does not say how long it lasts."""

LEAST_SECONDS = 2.0
"""A scene that is played lasts at least so long."""

PLACES = 64
"""Of a camera on its way that a player is told of, at most."""

FILMED = 0.9
"""Share of the views which have a neighbour in time, from which on one camera has filmed them."""


def read_data(run: Run, data: Path | None) -> Scene | None:
    """Return what a run sees of its scene, None if it is not where it was.

    Raises:
        DataError: ``data`` is given and is not the run's, or cannot be read.
    """
    place = data or run.data
    if place is None or (data is None and not place.is_dir()):
        return None
    return run.part_of(read_scene(place))


def judge_of(run: Run, model: Model, scene: Scene | None) -> Judge:
    """Return what compares models with that of a run: in train views, or else on a circle.

    Train views have the smaller errors, so what is lost shows more than in others.
    """
    torch.set_num_threads(1)  # its own threads would take the kernels' cores
    engine, options = raster.best_engine("cpu"), run.preset.data
    colour = BACKGROUNDS[options.background]
    if scene is None:
        say.warn(
            "the data is not there, so what coding loses is measured on a circle, as if the run "
            "had 40 dB; say with --data where it is"
        )
        shots = [(camera, i / VIEWS) for i, camera in enumerate(_circle(run.facts.bound))]
        return Judge(model, shots, None, engine, torch.tensor(colour))
    pictures = Pictures(colour, options.downscale, options.cache_mib << 20)
    views = sorted(scene.split("train"), key=lambda view: view.time)
    chosen = [views[i * len(views) // VIEWS] for i in range(VIEWS)][: len(views)]
    shots = [(pictures.camera(view), view.time) for view in chosen]
    return Judge(model, shots, list(map(pictures.load, chosen)), engine, torch.tensor(colour))


def _circle(bound: float) -> list[Camera]:
    """Return cameras on a circle round the origin, a little above it."""
    focal = CIRCLE_SIZE / 2 / math.tan(CIRCLE_VIEW / 2)
    up, distance = np.array([0.0, 0.0, 1.0]), 2 * bound / math.tan(CIRCLE_VIEW / 2)
    middle = CIRCLE_SIZE / 2
    cameras = []
    for i in range(VIEWS):
        angle = 2 * math.pi * i / VIEWS
        place = distance * np.array([math.cos(angle), math.sin(angle), 0.3])
        pose = look_at(place, np.zeros(3), up)
        size = CIRCLE_SIZE, CIRCLE_SIZE
        cameras.append(Camera(pose, focal, focal, middle, middle, *size))
    return cameras


def scene_facts(run: Run, model: Model, scene: Scene | None) -> dict[str, Any]:
    """Return what a player is told of a scene, see docs/file-format.md."""
    views = [] if scene is None else scene.split("train")
    cameras = [view.camera for view in views] or _circle(run.facts.bound)
    duration = None if scene is None else scene.duration
    seconds = duration or max(run.facts.frames / FRAMES_A_SECOND, LEAST_SECONDS)
    means = model.splats.means.detach().double().cpu().numpy()
    first = cameras[0]
    facts = {
        "bound": run.facts.bound,
        "up": common_up(cameras).tolist(),
        "background": list(BACKGROUNDS[run.preset.data.background]),
        "seconds": seconds,
        "view": _placed(first, means)
        | {
            "fov_x": 2 * math.atan(first.width / 2 / first.fx),
            "fov_y": 2 * math.atan(first.height / 2 / first.fy),
        },
    }
    if way := way_of_the_camera(views):
        facts["path"] = [{"time": view.time} | _placed(view.camera, means) for view in way]
    return facts


def way_of_the_camera(views: Sequence[View]) -> list[View]:
    """Return some of the views in the order of time, if one camera has filmed all on its way."""
    ordered = sorted(views, key=lambda view: view.time)
    if len({view.time for view in ordered}) < max(len(ordered), 2):
        return []
    if sum(map(bool, neighbours(ordered).values())) < FILMED * len(ordered):
        return []
    rows = np.linspace(0, len(ordered) - 1, min(len(ordered), PLACES)).round().astype(int)
    return [ordered[row] for row in rows]


def _placed(camera: Camera, means: NDArray[np.float64]) -> dict[str, Any]:
    """Return where a camera is, and what it looks at: as far away as most of what it sees."""
    depths = means @ camera.rotation[2] + camera.translation[2]
    depths = depths[depths > 0]
    distance = float(np.median(depths)) if len(depths) else 1.0
    return {
        "position": camera.centre.tolist(),
        "target": (camera.centre + distance * camera.rotation[2]).tolist(),
        "up": (-camera.rotation[1]).tolist(),
    }
