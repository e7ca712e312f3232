"""Finds cameras of the frames between keyframes, from the points that these have in common.

What moves is seen well only at many moments, but a few dozen cameras do for what stands still.
So COLMAP finds those of keyframes, and every other frame is placed by itself:
its features are compared with those of the keyframes beside it of which the places in space are
known, and the camera follows from these (LO-RANSAC, then least squares with a robust loss).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.capture.features import Features
from gsdmsr_cli.capture.masks import standing_features
from gsdmsr_cli.capture.model import point_places, point_rows, pose_of
from gsdmsr_cli.ground.limits import cores
from gsdmsr_cli.scene.native import load_pycolmap

Floats = NDArray[np.float64]

BESIDE = 4
"""Keyframes, those nearest in time, with which a frame is compared; all if these do not do."""

RATIO = 0.8
"""The best match of a feature must be so much closer than the second best (Lowe 2004)."""

LEAST = 30
"""Fewer points do not make a camera."""

OFF = 6.0
"""Points that are seen farther from where they should be do not count [px]."""

PLACED = "placed.npz"


@dataclass(frozen=True, eq=False)
class _Keyframe:
    """A frame whose camera is known.

    Attributes:
        place: number among all frames.
        features: those of which the places in space are known.
        points: (N,) which points they are, as rows of ``Reconstruction.points``.
    """

    place: int
    features: Features
    points: NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class _Placed:
    """A frame's camera, (4, 4) world to camera, and the points (K,) that it was found by."""

    pose: Floats
    points: NDArray[np.int64]


def place_between(
    out: str,
    largest: str,
    names: Sequence[str],
    features: str,
    masks: str | None,
    seed: int,
    on_progress: Callable[[int, int], None],
) -> None:
    """Write the cameras of frames that a model has none of to ``out``, as far as they are found.

    Args:
        out: folder to write.
        largest: folder of COLMAP's model of the keyframes.
        names: of all frames' files, in the order of time.
        features: folder of their features.
        masks: folder of their masks; features on what moves are left out.
        seed: of the sampling.
        on_progress: called with how many are done, and of how many.
    """
    model = load_pycolmap().Reconstruction(largest)
    (camera,) = model.cameras.values()
    rows, places = point_rows(model), point_places(model)
    folders = Path(features), None if masks is None else Path(masks)
    images = {model.images[i].name: model.images[i] for i in model.reg_image_ids()}
    keyframes = [
        _keyframe(place, standing_features(*folders, name), images[name], rows)
        for place, name in enumerate(names)
        if name in images
    ]
    wanted = [place for place, name in enumerate(names) if name not in images]

    def work(place: int) -> _Placed | None:
        own = standing_features(*folders, names[place])
        ordered = sorted(keyframes, key=lambda key: (abs(key.place - place), key.place))
        placed = _placed(own, ordered[:BESIDE], places, camera, seed)
        return placed or _placed(own, ordered, places, camera, seed)

    found: dict[str, _Placed] = {}
    with ThreadPoolExecutor(cores()) as pool:
        for done, (place, placed) in enumerate(
            zip(wanted, pool.map(work, wanted), strict=True), start=1
        ):
            if placed is not None:
                found[names[place]] = placed
            on_progress(done, len(wanted))
    counts = np.array([len(placed.points) for placed in found.values()], np.int64)
    np.savez(
        Path(out) / PLACED,
        names=np.array(list(found), np.str_),
        poses=np.array([placed.pose for placed in found.values()]).reshape(-1, 4, 4),
        counts=counts,
        points=np.concatenate([np.zeros(0, np.int64), *(one.points for one in found.values())]),
    )


def _keyframe(place: int, own: Features, image: Any, rows: dict[int, int]) -> _Keyframe:
    """Return a keyframe; COLMAP's image has a point or none for each of its features."""
    known = np.array([point.has_point3D() for point in image.points2D], np.bool_)
    points = [rows[point.point3D_id] for point in image.points2D if point.has_point3D()]
    return _Keyframe(place, own.where(known), np.array(points, np.int64))


def _placed(
    own: Features, keyframes: Sequence[_Keyframe], places: Floats, camera: Any, seed: int
) -> _Placed | None:
    """Return the camera of a frame with its own features, None if there are too few points.

    Args:
        own: its features.
        keyframes: to compare it with.
        places: (P, 3) of the points.
        camera: COLMAP's, of all frames.
        seed: of the sampling.
    """
    pairs: set[tuple[int, int]] = set()
    for key in keyframes:
        here, there = matched(own.descriptors, key.features.descriptors)
        pairs |= set(zip(here.tolist(), key.points[there].tolist(), strict=True))
    if len(pairs) < LEAST:
        return None
    rows, points = np.array(sorted(pairs)).T
    colmap = load_pycolmap()
    estimation = colmap.AbsolutePoseEstimationOptions()
    estimation.ransac.max_error, estimation.ransac.random_seed = OFF, seed
    result = colmap.estimate_and_refine_absolute_pose(
        own.pixels[rows].astype(np.float64), places[points], camera, estimation
    )
    if result is None or result["num_inliers"] < LEAST:
        return None
    inliers = np.asarray(result["inlier_mask"], np.bool_)
    return _Placed(pose_of(result["cam_from_world"]), np.unique(points[inliers]))


def matched(
    first: NDArray[np.uint8], second: NDArray[np.uint8]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return rows of descriptors (N, 128) and (M, 128) that match, each the other's best."""
    if len(first) < 2 or len(second) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    a, b = first.astype(np.float32), second.astype(np.float32)
    # whole numbers below 2^24, so sums are exact, whatever their order
    products = a @ b.T
    squares = np.square(a).sum(1)[:, None] - 2 * products + np.square(b).sum(1)[None]
    best, back = squares.argmin(1), squares.argmin(0)
    rows = np.arange(len(a))
    two = np.partition(squares, 1, axis=1)[:, :2]
    good = (back[best] == rows) & (two[:, 0] < RATIO**2 * two[:, 1])
    return rows[good], best[good]
