"""Reads what COLMAP has found as arrays: one lens, the cameras and the points they see."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.capture.between import PLACED
from gsdmsr_cli.capture.colmap import LARGEST, PARTS
from gsdmsr_cli.capture.model import point_places, point_rows, pose_of
from gsdmsr_cli.ground.files import read_json
from gsdmsr_cli.scene.lens import Lens
from gsdmsr_cli.scene.native import load_pycolmap

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The largest model of a capture; N cameras in the order of time, P points.

    Attributes:
        lens: of all cameras.
        names: files of the frames whose cameras were found.
        poses: (N, 4, 4) world to camera, in units of COLMAP's choice.
        points: (P, 3) positions.
        colours: (P, 3) uint8.
        errors: (P,) mean reprojection error of each point [px].
        tracks: (P,) number of frames that each was found in.
        seen: for every camera, which points it was found in, as indices, (K,).
        parts: files of the frames of each model, largest first.
    """

    lens: Lens
    names: tuple[str, ...]
    poses: Floats
    points: Floats
    colours: NDArray[np.uint8]
    errors: Floats
    tracks: NDArray[np.int64]
    seen: tuple[NDArray[np.int64], ...]
    parts: tuple[tuple[str, ...], ...]

    @property
    def centres(self) -> Floats:
        """(N, 3) positions of the cameras."""
        rotations, shifts = self.poses[:, :3, :3], self.poses[:, :3, 3]
        centres: Floats = -np.einsum("nij,ni->nj", rotations, shifts)
        return centres

    @property
    def mean_error(self) -> float:
        """Reprojection error, the mean over all observations [px]."""
        return float((self.errors * self.tracks).sum() / max(self.tracks.sum(), 1))


def read_reconstruction(folder: Path) -> Reconstruction:
    """Return the model that ``capture.colmap.map_frames`` has written to ``folder``."""
    model = load_pycolmap().Reconstruction(str(folder / LARGEST))
    images = sorted((model.images[i] for i in model.reg_image_ids()), key=lambda i: i.name)
    rows = point_rows(model)
    points = [model.points3D[i] for i in rows]
    (camera,) = model.cameras.values()
    return Reconstruction(
        lens=lens_of(camera.model_name, camera.params, camera.width, camera.height),
        names=tuple(image.name for image in images),
        poses=np.stack([pose_of(image.cam_from_world()) for image in images]),
        points=point_places(model),
        colours=np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        errors=np.array([point.error for point in points], np.float64),
        tracks=np.array([point.track.length() for point in points], np.int64),
        seen=tuple(_seen(image, rows) for image in images),
        parts=tuple(tuple(part) for part in read_json(folder / PARTS)["parts"]),
    )


def with_placed(found: Reconstruction, folder: Path) -> Reconstruction:
    """Return a reconstruction with the cameras that ``place_between`` has written beside its own.

    Points, their errors and the number of frames that each was found in stay those of keyframes.
    """
    with np.load(folder / PLACED) as arrays:
        names = [str(name) for name in arrays["names"]]
        poses, ends = arrays["poses"], np.cumsum(arrays["counts"])[:-1]
        seen = np.split(arrays["points"], ends) if names else []
    both = sorted(
        zip((*found.names, *names), (*found.poses, *poses), (*found.seen, *seen), strict=True),
        key=lambda one: one[0],
    )
    ordered, all_poses, all_seen = zip(*both, strict=True)
    return replace(found, names=ordered, poses=np.stack(all_poses), seen=all_seen)


def _seen(image: Any, rows: dict[int, int]) -> NDArray[np.int64]:
    found = {rows[point.point3D_id] for point in image.get_observation_points2D()}
    return np.array(sorted(found), np.int64)


def lens_of(model: str, params: NDArray[np.float64], width: int, height: int) -> Lens:
    """Return the lens of a camera in one of COLMAP's models, see ``options.CAMERA_MODELS``.

    Their parameters are one focal length or two, the principal point and the terms of distortion.
    """
    values = tuple(float(value) for value in params)
    focals = 1 if model in ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL") else 2
    terms = values[focals + 2 :]
    brown = model == "OPENCV"
    return Lens(
        fx=values[0],
        fy=values[focals - 1],
        cx=values[focals],
        cy=values[focals + 1],
        width=width,
        height=height,
        radial=terms[:2] if brown else terms,
        tangential=(terms[2], terms[3]) if brown else (0.0, 0.0),
        fisheye=model == "OPENCV_FISHEYE",
    )
