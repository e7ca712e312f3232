"""Prepares a camera rig: fixed cameras that film together get one time axis and a pose each.

Cameras are found from one picture of each, the median of a few moments: what moves is gone from it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.capture.candidates import Candidate
from gsdmsr_cli.capture.features import find_features
from gsdmsr_cli.capture.frames import NOTE, PICTURES, shrunk
from gsdmsr_cli.capture.source import Source
from gsdmsr_cli.ground.errors import DataError, UsageError, nearest
from gsdmsr_cli.ground.files import read_json, write_json
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.scene.high_range import high_ranges
from gsdmsr_cli.scene.imaging import read_image, write_png
from gsdmsr_cli.scene.native import cv2
from gsdmsr_cli.scene.scene import View
from gsdmsr_cli.scene.video import read_video, video_length

Picture = NDArray[np.uint8]
Floats = NDArray[np.float64]
LEAST = 3
"""Fewer cameras do not make a rig."""

MEDIAN_OF = 9
"""So many moments, evenly chosen, make the picture in which what moves is gone."""

STILL = 0.004
"""A camera whose picture shifts by more than this share of its longer side does not stand still."""

_MATCHES = 30  # fewer between the first and last picture prove nothing
_MOMENTS, _RIG = "moments", "rig.json"


@dataclass(frozen=True)
class Rig:
    """The pictures of a rig.

    Attributes:
        folder: of the pictures of all cameras at all moments.
        cameras: names of the videos, without their suffix.
        times: the moments, seconds from the first.
    """

    folder: Path
    cameras: tuple[str, ...]
    times: tuple[float, ...]

    def views(self, of_cameras: Sequence[View]) -> tuple[View, ...]:
        """Return a view of every camera at every moment; the first camera is for testing.

        Args:
            of_cameras: a view of each camera that was found, whose name is its number.
        """
        last = self.times[-1] or 1.0
        return tuple(
            replace(
                view,
                name=f"{self.cameras[int(view.name)]}_{k:05d}",
                time=time / last,
                split="train" if i else "test",
                image_path=Path("images") / _file_name(int(view.name), k),
            )
            for i, view in enumerate(of_cameras)
            for k, time in enumerate(self.times)
        )


def _file_name(camera: int, moment: int) -> str:
    return f"{camera:02d}_{moment:05d}.png"


def parse_offsets(texts: Sequence[str]) -> dict[str, float]:
    """Return seconds by camera from texts such as ``left=0.25``.

    Raises:
        UsageError: a text is not of that form.
    """
    offsets = {}
    for text in texts:
        name, _, seconds = text.rpartition("=")
        try:
            offsets[name] = float(seconds)
        except ValueError:
            offsets[name] = float("nan")
        if not name or not np.isfinite(offsets[name]):
            raise UsageError(f"--offset {text}: must be CAMERA=SECONDS, such as left=0.25")
    return offsets


def write_rig(
    folder: Path,
    source: Source,
    most: int,
    max_side: int,
    offsets: Mapping[str, float],
    on_progress: OnProgress,
) -> None:
    """Write the pictures of all cameras at up to ``most`` common moments, and what finds them.

    Args:
        folder: to write.
        source: the videos.
        most: moments, at most.
        max_side: longer side of the pictures [px].
        offsets: seconds by which a camera's clock is ahead of the others'.
        on_progress: called with the frames read, and of how many.

    Raises:
        DataError: there are too few cameras, they differ in size or do not stand still, or their
            films do not overlap.
        UsageError: an offset is for a camera that is not there.
    """
    names = [path.stem for path in source.files]
    for name in offsets:
        if name not in names:
            raise UsageError(f"--offset {name}: is no camera; {nearest(name, names)}")
    if len(names) < LEAST:
        raise DataError(f"{source.root}: {len(names)} videos; a rig has at least {LEAST} cameras")
    total = 2 * sum(video_length(path) for path in source.files)
    counted = count_calls(lambda done: on_progress(done, max(done, total)))
    clocks = [_read_clock(path, offsets.get(path.stem, 0.0), counted) for path in source.files]
    moments = common_moments(clocks, most, source.root)
    (folder / _MOMENTS).mkdir()
    (folder / PICTURES).mkdir()
    sizes = []
    for camera, (path, clock) in enumerate(zip(source.files, clocks, strict=True)):
        nearest_frames = np.abs(clock[None] - moments[:, None]).argmin(axis=1)
        sizes.append(_write_moments(folder, camera, path, nearest_frames, max_side, counted))
        if sizes[-1] != sizes[0]:
            raise DataError(
                f"{path}: its pictures have another shape than those of {source.files[0].name}; "
                "the cameras of a rig share one lens"
            )
        _write_reference(folder, camera, len(moments), path)
    times = (moments - moments[0]).tolist()
    write_json(folder / _RIG, {"cameras": names, "times": times})
    taken = [asdict(Candidate(name, 0, float(i))) for i, name in enumerate(names)]
    write_json(
        folder / NOTE,
        {
            "frames": taken, "blurred": [], "cuts": [], "plain": 0,
            "high_range": high_ranges(source.files), "of_pictures": True, "in_seconds": False,
            "size": sizes[0], "original_size": sizes[0], "focal": None,
        },
    )  # fmt: skip


def count_calls(on_progress: Callable[[int], None]) -> Callable[[], None]:
    """Return a function that reports, at each call, how often it has been called."""
    numbers = count(1)
    return lambda: on_progress(next(numbers))


def _read_clock(path: Path, ahead: float, counted: Callable[[], None]) -> Floats:
    """Return the time of every frame of a video, on the clock of the rig [s]."""
    times = []
    for time, _ in read_video(path):
        times.append(time - ahead)
        counted()
    return np.array(times)


def _write_moments(
    folder: Path,
    camera: int,
    path: Path,
    frames: NDArray[np.int64],
    max_side: int,
    counted: Callable[[], None],
) -> tuple[int, int]:
    """Write the chosen frames of a video, one for every moment; return their width and height."""
    size = 0, 0
    for index, (_, picture) in enumerate(read_video(path)):
        for moment in (frames == index).nonzero()[0]:
            small = shrunk(picture, max_side)
            size = small.shape[1], small.shape[0]
            write_png(folder / _MOMENTS / _file_name(camera, int(moment)), small)
        counted()
    return size


def read_rig(folder: Path) -> Rig:
    """Return what ``write_rig`` has written."""
    note = read_json(folder / _RIG)
    return Rig(folder / _MOMENTS, tuple(note["cameras"]), tuple(note["times"]))


def common_moments(clocks: Sequence[Floats], most: int, root: Path) -> Floats:
    """Return up to ``most`` moments, evenly over the time in which all cameras film.

    As many as the slowest camera has frames there, if those are fewer.

    Raises:
        DataError: there is no such time.
    """
    first, last = max(clock[0] for clock in clocks), min(clock[-1] for clock in clocks)
    inside = [int(((clock >= first) & (clock <= last)).sum()) for clock in clocks]
    if last <= first or min(inside) < 2:
        raise DataError(f"{root}: the cameras do not film at the same time; check --offset")
    return np.linspace(first, last, min(most, *inside))


def _write_reference(folder: Path, camera: int, moments: int, path: Path) -> None:
    """Write the median of a few moments of a camera.

    Raises:
        DataError: the camera does not stand still.
    """
    chosen = np.linspace(0, moments - 1, min(MEDIAN_OF, moments)).round().astype(int)
    pictures = [read_image(folder / _MOMENTS / _file_name(camera, int(k))) for k in chosen]
    if shift(pictures[0], pictures[-1]) > STILL * max(pictures[0].shape):
        raise DataError(
            f"{path}: this camera moves; --rig is for cameras that stand still: prepare one that "
            "moves by itself"
        )
    median = np.median(np.stack(pictures), axis=0).astype(np.uint8)
    write_png(folder / PICTURES / f"{camera:05d}.png", median)


def shift(first: Picture, second: Picture) -> float:
    """Return how far features move from one picture to another, in the median [px].

    0 where too few match.
    """
    greys = (cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY) for picture in (first, second))
    one, other = (find_features(np.asarray(grey, dtype=np.uint8), 1000) for grey in greys)
    if not len(one.pixels) or not len(other.pixels):
        return 0.0
    matcher = cv2.BFMatcher(cv2.NORM_L2, crossCheck=True)
    pairs = matcher.match(one.descriptors, other.descriptors)
    if len(pairs) < _MATCHES:
        return 0.0
    moved = [other.pixels[pair.trainIdx] - one.pixels[pair.queryIdx] for pair in pairs]
    return float(np.median(np.linalg.norm(moved, axis=1)))
