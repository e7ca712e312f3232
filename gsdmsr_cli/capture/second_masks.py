"""Finds moving parts a second time, with what stands still as a model.

A model such as the preset ``static-video`` trains is drawn from every camera. What moves has other
colours than are drawn there, and a flow that contradicts the motion of the camera. Each of the two
is wrong where the other is not: colours at edges that the model does not meet, flow where there is
no texture and beside what moves. So what is asked for is more than either can say alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.capture.masks import write_mask
from gsdmsr_cli.capture.motion import LONGEST, OFF, Flows, cleaned, off_camera
from gsdmsr_cli.capture.options import Options
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.native import cv2
from gsdmsr_cli.scene.optical_flow import Grey
from gsdmsr_cli.scene.scene import MOVING, Scene, View

Floats32 = NDArray[np.float32]

DIFFERENT = 0.03
"""A difference of colours that counts as much as a flow that is ``OFF`` [shares of white]."""

ENOUGH = 1.3
"""Sum of the two from which a pixel moves; each counts as 1 at most."""

FITTING = 0.8
"""Share of a picture's pixels by which its exposure is found: those that differ least."""

_ROUNDS = 3


@dataclass(frozen=True, eq=False)
class Standing:
    """A model of what stands still in a scene.

    Attributes:
        key: tells it from others.
        draw: returns a view as the model shows it, (H, W, 3) in [0, 1].
        true: returns the view's picture in the same size.
    """

    key: str
    draw: Callable[[View], Floats32]
    true: Callable[[View], Floats32]


def write_second_masks(
    folder: Path, scene: Scene, standing: Standing, on_progress: OnProgress
) -> None:
    """Write a mask for every view on the camera's path, where ``with_masks`` finds it.

    Args:
        folder: to write.
        scene: of one camera that goes on a path.
        standing: what stands still in it.
        on_progress: called with how many views are done, and of how many.

    Raises:
        DataError: a picture cannot be read, or the scene is of another kind, see ``on_path``.
    """
    views = on_path(scene)
    camera = _small(views[0].camera)
    pixels = np.stack(np.meshgrid(*(np.arange(n) + 0.5 for n in (camera.width, camera.height))), -1)
    rays = (pixels - (camera.cx, camera.cy)) / (camera.fx, camera.fy)
    flows = Flows([_grey(_resized(standing.true(view), camera)) for view in views])
    poses = [view.camera.world_to_camera for view in views]
    spacing = max(1, round(len(views) / Options.keyframes))
    for i, view in enumerate(views):
        flow = off_camera(i, flows, rays, poses, spacing) * camera.fx / OFF
        shown = (_resized(of(view), camera) for of in (standing.draw, standing.true))
        colours = beyond(*shown) / DIFFERENT
        moving = cleaned(np.minimum(flow, 1) + np.minimum(colours, 1) > ENOUGH)
        write_mask(folder / _name(view), moving, (view.camera.width, view.camera.height))
        on_progress(i + 1, len(views))


def with_masks(scene: Scene, folder: Path) -> Scene:
    """Return the scene with the masks that ``write_second_masks`` has written.

    Views beside the camera's path keep those that they have.
    """
    masked = set(map(id, on_path(scene)))
    views = (
        replace(view, signals={**view.signals, MOVING: folder / _name(view)})
        if id(view) in masked
        else view
        for view in scene.views
    )
    return replace(scene, views=tuple(views))


def on_path(scene: Scene) -> list[View]:
    """Return the views of the camera that films on its way, by their times.

    Those of train, and of the others what is of moments of its own: what shows the same moment
    again is of another camera, and has no flow to its neighbours in time.

    Raises:
        DataError: train has several pictures of a moment, or pictures are taken through a lens, or
            are of several sizes.
    """
    train = scene.split("train")
    taken = {view.time: view for view in train}
    if len(taken) < len(train):
        raise DataError(
            f"{scene.root}: has {len(train)} train pictures of {len(taken)} moments; --masks-of is "
            "for one camera that films on its way"
        )
    for view in scene.views:
        taken.setdefault(view.time, view)
    views = [taken[time] for time in sorted(taken)]
    if any(view.lens is not None for view in views):
        raise DataError(
            f"{scene.root}: its pictures are taken through a lens; prepare it without --masks-of, "
            "train on that scene, and prepare that one with --masks-of"
        )
    sizes = {(view.camera.width, view.camera.height) for view in views}
    if len(sizes) > 1:
        shown = " and ".join(f"{width} x {height}" for width, height in sorted(sizes)[:2])
        raise DataError(f"{scene.root}: pictures of {shown} px; --masks-of needs them of one size")
    return views


def beyond(drawn: Floats32, true: Floats32) -> Floats32:
    """Return how far colours are outside of those that are drawn next to them, (H, W).

    Neighbours count because an edge that is drawn half a pixel beside its own is no motion.

    Args:
        drawn: (H, W, 3), whose exposure is fitted to the picture first.
        true: (H, W, 3) the picture.
    """
    fitted = _exposed(drawn, true)
    around = np.ones((3, 3), np.uint8)
    lowest, highest = cv2.erode(fitted, around), cv2.dilate(fitted, around)
    outside = np.maximum(np.maximum(lowest - true, true - highest), 0)
    return np.asarray(outside.mean(axis=2), np.float32)


def _exposed(drawn: Floats32, true: Floats32) -> Floats32:
    """Return the affine transform of the drawn colours that fits most of the picture best."""
    rows = np.concatenate([drawn, np.ones_like(drawn[..., :1])], axis=2).reshape(-1, 4)
    wanted, fits = true.reshape(-1, 3), np.ones(len(rows), bool)
    fitted = wanted
    for _ in range(_ROUNDS):
        fitted = rows @ np.linalg.lstsq(rows[fits], wanted[fits], rcond=None)[0]
        differences = np.abs(fitted - wanted).mean(axis=1)
        fits = differences <= np.quantile(differences, FITTING)
    return np.asarray(fitted.reshape(true.shape), np.float32)


def _small(camera: Camera) -> Camera:
    scale = min(1.0, LONGEST / max(camera.width, camera.height))
    return camera.resized(round(camera.width * scale), round(camera.height * scale))


def _resized(picture: Floats32, camera: Camera) -> Floats32:
    size = camera.width, camera.height
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.float32)


def _grey(picture: Floats32) -> Grey:
    return np.rint(255 * cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)).astype(np.uint8)


def _name(view: View) -> str:
    return f"{view.split}_{view.name}.png"
