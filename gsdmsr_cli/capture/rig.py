"""Prepares a camera rig: fixed cameras that film together get one time axis and a pose each.

Cameras are found from one picture of each, the median of a few moments: what moves is gone from it.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.capture.agreement import Film, clock_doubts
from gsdmsr_cli.capture.candidates import Candidate
from gsdmsr_cli.capture.clocks import common_moments, doubts_about, frames_at
from gsdmsr_cli.capture.cuts import Thumbnail, change, thumbnail
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
        missing: by the number of a camera, the moments at which it has no frame.
    """

    folder: Path
    cameras: tuple[str, ...]
    times: tuple[float, ...]
    missing: Mapping[int, Collection[int]] = field(default_factory=dict)

    def views(self, of_cameras: Sequence[View]) -> tuple[View, ...]:
        """Return a view of every camera at every moment it has; the first camera is for testing.

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
            if k not in self.missing.get(int(view.name), ())
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

    Videos that cannot be read are left out, and moments of which a camera has lost the frame.

    Args:
        folder: to write.
        source: the videos.
        most: moments, at most.
        max_side: longer side of the pictures [px].
        offsets: seconds by which a camera's clock is ahead of the others'.
        on_progress: called with the frames read, and of how many.

    Raises:
        DataError: too few cameras can be read, they differ in size or do not stand still, or their
            films do not overlap.
        UsageError: an offset is for a camera that is not there.
    """
    names = [path.stem for path in source.files]
    for name in offsets:
        if name not in names:
            raise UsageError(f"--offset {name}: is no camera; {nearest(name, names)}")
    if len(names) < LEAST:
        raise DataError(f"{source.root}: {len(names)} videos; a rig has at least {LEAST} cameras")
    total = 2 * sum(map(_length, source.files))
    counted = count_calls(lambda done: on_progress(done, max(done, total)))
    films, broken = _read_films(source, offsets, counted)
    files, names = list(films), [path.stem for path in films]
    clocks = [film.times for film in films.values()]
    moments = common_moments(clocks, most, source.root)
    (folder / _MOMENTS).mkdir()
    (folder / PICTURES).mkdir()
    sizes, missing = [], {}
    for camera, (path, clock) in enumerate(zip(files, clocks, strict=True)):
        frames = frames_at(clock, moments)
        missing[camera] = (frames < 0).nonzero()[0].tolist()
        sizes.append(_write_moments(folder, camera, path, frames, max_side, counted))
        if sizes[-1] != sizes[0]:
            raise DataError(
                f"{path}: its pictures have another shape than those of {files[0].name}; "
                "the cameras of a rig share one lens"
            )
        _write_reference(folder, camera, (frames >= 0).nonzero()[0], path)
    times = (moments - moments[0]).tolist()
    write_json(folder / _RIG, {"cameras": names, "times": times, "missing": [*missing.values()]})
    doubts = doubts_about([path.name for path in files], clocks, moments)
    doubts += clock_doubts([*films.values()])
    taken = [asdict(Candidate(name, 0, float(i))) for i, name in enumerate(names)]
    write_json(
        folder / NOTE,
        {
            "frames": taken, "blurred": [], "cuts": [], "plain": 0,
            "high_range": high_ranges(files), "doubts": broken + doubts,
            "of_pictures": True, "in_seconds": False,
            "size": sizes[0], "original_size": sizes[0], "focal": None,
        },
    )  # fmt: skip


def count_calls(on_progress: Callable[[int], None]) -> Callable[[], None]:
    """Return a function that reports, at each call, how often it has been called."""
    numbers = count(1)
    return lambda: on_progress(next(numbers))


def _length(path: Path) -> int:
    """Return how many frames a video announces, 0 if it cannot be opened."""
    try:
        return video_length(path)
    except DataError:
        return 0


def _read_films(
    source: Source, offsets: Mapping[str, float], counted: Callable[[], None]
) -> tuple[dict[Path, Film], list[str]]:
    """Return what there is of every video that can be read, and a sentence on each of the others.

    Raises:
        DataError: too few can be read.
    """
    films: dict[Path, Film] = {}
    broken = []
    for path in source.files:
        try:
            films[path] = _read_film(path, offsets.get(path.stem, 0.0), counted)
        except DataError as error:
            reason = str(error).removeprefix(f"{path}: ")
            broken.append(f"{path.name} is left out of the rig: {reason}")
    if len(films) < LEAST:
        raise DataError(
            f"{source.root}: {len(films)} of {len(source.files)} videos can be read; a rig has at "
            f"least {LEAST} cameras; {broken[0]}"
        )
    return films, broken


def _read_film(path: Path, ahead: float, counted: Callable[[], None]) -> Film:
    """Return the time of every frame of a video, on the clock of the rig, and what changes."""
    times, changes = [], []
    last: Thumbnail | None = None
    for time, picture in read_video(path):
        times.append(time - ahead)
        seen = thumbnail(picture)
        changes += [] if last is None else [change(last, seen)]
        last = seen
        counted()
    return Film(path.name, np.array(times), np.array(changes))


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
    missing = dict(enumerate(map(frozenset, note.get("missing", ()))))
    return Rig(folder / _MOMENTS, tuple(note["cameras"]), tuple(note["times"]), missing)


def _write_reference(folder: Path, camera: int, moments: NDArray[np.int64], path: Path) -> None:
    """Write the median of a few of the moments at which a camera has frames.

    Raises:
        DataError: there are none, or the camera does not stand still.
    """
    if not len(moments):
        raise DataError(f"{path}: has no frame at any of the moments that are taken; move it away")
    count = min(MEDIAN_OF, len(moments))
    chosen = moments[np.linspace(0, len(moments) - 1, count).round().astype(int)]
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
