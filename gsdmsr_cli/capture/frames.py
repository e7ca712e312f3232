"""Chooses sharp pictures of a capture as frames, and writes them upright and in one size."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.capture.candidates import (
    Candidate,
    choose,
    leave_out_blurred,
    leave_out_plain,
)
from gsdmsr_cli.capture.cuts import (
    Thumbnail,
    change,
    find_cuts,
    longest_shot,
    thumbnail,
)
from gsdmsr_cli.capture.exif import ExifTags, read_exif, upright
from gsdmsr_cli.capture.source import Source
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import read_json, write_json
from gsdmsr_cli.ground.limits import cores
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.scene.high_range import high_ranges
from gsdmsr_cli.scene.imaging import read_image, write_png
from gsdmsr_cli.scene.native import cv2
from gsdmsr_cli.scene.picture_files import IN_CAPTURES
from gsdmsr_cli.scene.video import read_video, video_length

Picture = NDArray[np.uint8]
LEAST = 8
"""Fewer frames do not make a scene."""

PICTURES, NOTE = "pictures", "frames.json"
"""Folder and file that ``read_frames`` reads."""

_SHARPNESS_SIDE = 640  # longer side at which sharpness is measured [px]


@dataclass(frozen=True)
class Frames:
    """The chosen frames in the order of time.

    Attributes:
        folder: of their pictures.
        names: of their files.
        taken: what each was.
        of_pictures: whether each is a file of its own, not a part of a video.
        in_seconds: whether times are seconds.
        size: width and height [px].
        original_size: before they were shrunk [px].
        focal: focal length that the camera has noted [px], or None.
        blurred: those that were left out because they are blurred.
        cuts: where the videos have been cut, as a file and seconds in it; only the longest shot
            was looked at.
        plain: how many pictures were left out before, since they are of one colour.
        high_range: videos of high dynamic range, with what that is called.
        doubts: what else is doubtful, one sentence each.
    """

    folder: Path
    names: tuple[str, ...]
    taken: tuple[Candidate, ...]
    of_pictures: bool
    in_seconds: bool
    size: tuple[int, int]
    original_size: tuple[int, int]
    focal: float | None
    blurred: tuple[Candidate, ...]
    cuts: tuple[tuple[str, float], ...] = ()
    plain: int = 0
    high_range: tuple[tuple[str, str], ...] = ()
    doubts: tuple[str, ...] = ()

    @property
    def times(self) -> list[float]:
        """Time of every frame in [0, 1], over all that were chosen."""
        times = [frame.time for frame in self.taken]
        return [(time - times[0]) / (times[-1] - times[0]) for time in times]

    def some(self, count: int) -> Frames:
        """Return at most ``count`` of them, evenly in time."""
        taken = tuple(choose(self.taken, count))
        names = dict(zip(self.taken, self.names, strict=True))
        return replace(self, names=tuple(names[frame] for frame in taken), taken=taken)

    @property
    def duration(self) -> float | None:
        """Seconds from the first frame to the last, where they are known."""
        return self.taken[-1].time - self.taken[0].time if self.in_seconds else None


def write_frames(
    folder: Path, source: Source, count: int, max_side: int, on_progress: OnProgress
) -> None:
    """Choose frames from the source and write them and ``frames.json`` into ``folder``.

    Raises:
        DataError: a file cannot be read, there are too few frames, or they differ in size.
    """
    survey = _survey_videos if source.kind == "video" else _survey_pictures
    candidates, in_seconds, tags, cuts = survey(source, count, on_progress)
    showing = leave_out_plain(candidates)
    plain = len(candidates) - len(showing)
    taken, blurred = leave_out_blurred(choose(showing, count))
    if len(taken) < LEAST:
        shot = f", in the longest of {len(cuts) + 1} shots" if cuts else ""
        black = f", {plain} of them black or of one colour" if plain else ""
        raise DataError(
            f"{source.root}: {len(taken)} usable frames of {len(candidates)}{shot}{black}; at "
            f"least {LEAST} are needed: film for longer, or give more pictures"
        )
    (folder / PICTURES).mkdir()
    names = tuple(f"{i:05d}.png" for i in range(len(taken)))
    original_sizes = []
    for i, picture in enumerate(_pictures(source, taken, tags)):
        small = shrunk(picture, max_side)
        original_sizes.append((picture.shape[1], picture.shape[0]))
        if original_sizes[-1] != original_sizes[0]:
            raise DataError(
                f"{source.root}: {taken[i].file} is {_size(picture)} px, unlike {taken[0].file}; "
                "all must have one size: they share one lens"
            )
        write_png(folder / PICTURES / names[i], small)
        on_progress(len(candidates) + i + 1, len(candidates) + len(taken))
    size = small.shape[1], small.shape[0]
    focals = {own.focal for own in tags.values()}
    focal = focals.pop() if len(focals) == 1 else None
    write_json(
        folder / NOTE,
        {
            "frames": [asdict(frame) for frame in taken],
            "blurred": [asdict(frame) for frame in blurred],
            "cuts": cuts,
            "plain": plain,
            "high_range": high_ranges(source.files) if source.kind == "video" else [],
            "of_pictures": source.kind == "images",
            "in_seconds": in_seconds,
            "size": size,
            "original_size": original_sizes[0],
            "focal": None if focal is None else focal * math.hypot(*size),
        },
    )


def read_frames(folder: Path) -> Frames:
    """Return what ``write_frames`` has written."""
    note: dict[str, Any] = read_json(folder / NOTE)
    taken = tuple(Candidate(**frame) for frame in note["frames"])
    return Frames(
        folder=folder / PICTURES,
        names=tuple(f"{i:05d}.png" for i in range(len(taken))),
        taken=taken,
        of_pictures=note["of_pictures"],
        in_seconds=note["in_seconds"],
        size=(note["size"][0], note["size"][1]),
        original_size=(note["original_size"][0], note["original_size"][1]),
        focal=note["focal"],
        blurred=tuple(Candidate(**frame) for frame in note["blurred"]),
        cuts=tuple((file, time) for file, time in note.get("cuts", ())),
        plain=note.get("plain", 0),
        high_range=tuple((file, kind) for file, kind in note.get("high_range", ())),
        doubts=tuple(note.get("doubts", ())),
    )


def sharpness(picture: Picture) -> float:
    """Return the variance of the Laplacian of (H, W, C) pixels at a common size."""
    grey = cv2.cvtColor(shrunk(picture, _SHARPNESS_SIDE), cv2.COLOR_RGB2GRAY)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


_Cuts = list[tuple[str, float]]
_Survey = tuple[list[Candidate], bool, dict[str, ExifTags], _Cuts]


def _survey_videos(source: Source, count: int, on_progress: OnProgress) -> _Survey:
    """Return the frames of the longest shot as candidates.

    Videos follow one another without a gap and without a cut.
    """
    total = sum(video_length(path) for path in source.files)
    candidates: list[Candidate] = []
    cut_before: list[int] = []
    cuts: _Cuts = []
    start = 0.0
    for path in source.files:
        before, step = len(candidates), 0.0
        changes: list[float] = []
        last: Thumbnail | None = None
        for index, (time, picture) in enumerate(read_video(path)):
            step = start + time - candidates[-1].time if candidates else 0.0
            candidates.append(Candidate(path.name, index, start + time, sharpness(picture)))
            seen = thumbnail(picture)
            changes += [] if last is None else [change(last, seen)]
            last = seen
            on_progress(len(candidates), total + min(count, total))
        found = [before + index for index in find_cuts(changes)]
        cuts += [(path.name, candidates[index].time - start) for index in found]
        cut_before += found
        if len(candidates) - before > 1:
            start = candidates[-1].time + step
    shot = longest_shot([candidate.time for candidate in candidates], cut_before)
    return candidates[shot], True, {}, cuts


def _survey_pictures(source: Source, count: int, on_progress: OnProgress) -> _Survey:
    tags = {path.name: read_exif(path) for path in source.files}
    times, in_seconds = _picture_times(source.files, [tags[p.name].taken for p in source.files])
    order = np.argsort(times, kind="stable")
    files = [source.files[i] for i in order]
    with ThreadPoolExecutor(cores()) as pool:
        sharpnesses = pool.map(lambda path: sharpness(_rgb(read_image(path, IN_CAPTURES))), files)
        candidates = []
        for i, sharp in zip(order, sharpnesses, strict=True):
            time = times[i] - min(times)
            candidates.append(Candidate(source.files[i].name, 0, time, sharp))
            on_progress(len(candidates), len(files) + min(count, len(files)))
    return candidates, in_seconds, tags, []


def _picture_times(
    files: Sequence[Path], taken: Sequence[float | None]
) -> tuple[list[float], bool]:
    """Return each picture's time, and whether it is in seconds.

    The EXIF times where all pictures have different ones; else the numbers that the names end
    in, where those differ; else the order of the names.
    """
    known = [time for time in taken if time is not None]
    if len(set(known)) == len(files):
        return known, True
    numbers = [re.search(r"(\d+)\D*$", path.stem) for path in files]
    counted = [float(match[1]) for match in numbers if match]
    if len(set(counted)) == len(files):
        return counted, False
    return [float(i) for i in range(len(files))], False


def _pictures(
    source: Source, taken: Sequence[Candidate], tags: dict[str, ExifTags]
) -> Iterator[Picture]:
    """Yield the chosen pictures, (H, W, 3), in the order of time."""
    paths = {path.name: path for path in source.files}
    if source.kind == "images":
        for frame in taken:
            picture = _rgb(read_image(paths[frame.file], IN_CAPTURES))
            yield upright(picture, tags[frame.file].orientation)
        return
    for name, path in paths.items():
        wanted = {frame.index for frame in taken if frame.file == name}
        for index, (_, picture) in enumerate(read_video(path) if wanted else ()):
            if index in wanted:
                yield picture


def _rgb(picture: Picture) -> Picture:
    return picture[..., :3] if picture.shape[2] >= 3 else np.repeat(picture[..., :1], 3, axis=2)


def shrunk(picture: Picture, max_side: int) -> Picture:
    """Return (H, W, 3) pixels whose longer side is at most ``max_side``, by averaging areas."""
    height, width, _ = picture.shape
    scale = max_side / max(width, height)
    if scale >= 1:
        return picture
    shape = max(1, round(width * scale)), max(1, round(height * scale))
    return np.asarray(cv2.resize(picture, shape, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _size(picture: Picture) -> str:
    return f"{picture.shape[1]} x {picture.shape[0]}"
