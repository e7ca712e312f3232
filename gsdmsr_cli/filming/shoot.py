"""Draws a film: one thread draws, the others write, and what is there already is left alone."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.evaluation.protocol import Studio
from gsdmsr_cli.film import Film, Shot
from gsdmsr_cli.filming.crew import Crew, Video
from gsdmsr_cli.filming.encode import write_video
from gsdmsr_cli.filming.layers import Artist, Floats, Layers
from gsdmsr_cli.filming.outputs import CHANNELS, Ends, numbers, picture
from gsdmsr_cli.filming.record import Reel
from gsdmsr_cli.imaging import read_image, resize_area, write_exr, write_png

Pixels = NDArray[np.uint8]
Pictures = Mapping[str, Pixels]

ROOM_BYTES, MOST_ROOM = 512 << 20, 16
"""Memory for frames that wait to be written, and most such frames."""


@dataclass(frozen=True)
class Account:
    """How the time of a film was spent.

    Attributes:
        drawn, kept: frames drawn, and those that were there already.
        drawing: time in which frames were drawn [s].
        elapsed: wall time from the first frame to the last file [s].
    """

    drawn: int
    kept: int
    drawing: float
    elapsed: float


def shoot(
    studio: Studio,
    film: Film,
    reels: Sequence[Reel],
    ends: Ends,
    videos: Sequence[str],
    supersample: int,
    tell: Callable[[int, int], None],
) -> Account:
    """Draw what is missing of a film, and write its pictures, numbers and videos.

    Args:
        studio: what is drawn, and what draws it.
        film: cameras and moments.
        reels: where the outputs go, prepared.
        ends: of the colours.
        videos: kinds of videos; those that are there already are left as they are.
        supersample: each pixel is the mean of so many squared.
        tell: called with (frames done, frames in all).

    Raises:
        DataError: a file cannot be written, or a true picture not be read.
    """
    missing = [_missing(reels, i) for i in range(len(film.shots))]
    artist = Artist(studio, supersample, [reel.output for reel in reels])
    lab = Lab(studio, supersample, ends)
    if any(missing):
        _warm_up(artist, film.shots)
    drawing, started = 0.0, time.perf_counter()
    with Crew(_room(film.shots[0], supersample)) as crew:
        cans = [Can(reel, _videos(crew, reel, videos)) for reel in reels]
        for i, shot in enumerate(film.shots):
            job = None
            if missing[i]:
                following = film.shots[i + 1] if i + 1 < len(film.shots) else None
                before = time.perf_counter()
                layers = artist.draw(shot, following)
                drawing += time.perf_counter() - before
                job = crew.submit(partial(lab.develop, missing[i], i, shot, layers))
            for can in cans:
                can.add(crew, i, job if can.reel in missing[i] else None)
            tell(i + 1, len(film.shots))
    drawn, count = sum(map(bool, missing)), max(reel.count for reel in reels)
    return Account(drawn, count - drawn, drawing, time.perf_counter() - started)


@dataclass(frozen=True, eq=False)
class Lab:
    """Makes files of layers; called from many threads.

    Attributes:
        studio: has the true pictures.
        supersample: layers have so many times the pixels of a picture on each side.
        ends: of the colours.
    """

    studio: Studio
    supersample: int
    ends: Ends

    def develop(self, reels: Sequence[Reel], index: int, shot: Shot, drawn: Layers) -> Pictures:
        """Write the files of a frame, and return its pictures by the reels' names."""
        layers = drawn.shrunk(self.supersample)
        pictures = {}
        for reel in reels:
            true = self._true(shot) if reel.output == "error" else None
            pixels = picture(reel.output, layers, self.ends, true)
            exr = reel.exr(index)
            if exr is not None:
                write_exr(exr, numbers(reel.output, layers), CHANNELS[reel.output])
            write_png(reel.png(index), pixels)
            pictures[reel.name] = pixels
        return pictures

    def _true(self, shot: Shot) -> Floats:
        """Return the true picture in the size of the shot."""
        assert shot.view is not None
        true = self.studio.true(shot.view).numpy()
        camera = shot.camera
        if true.shape[:2] == (camera.height, camera.width):
            return true
        return resize_area(np.ascontiguousarray(true), camera.width, camera.height)


@dataclass(frozen=True, eq=False)
class Can:
    """A reel with the videos that are being made of it."""

    reel: Reel
    videos: list[Video]

    def add(self, crew: Crew, index: int, job: Future[Pictures] | None) -> None:
        """Add a frame to the videos: what ``job`` returns, or else what is on disk."""
        if not self.videos or index >= self.reel.count:
            return
        picture = partial(_of, job, self.reel.name) if job else self._read(crew, index)
        for video in self.videos:
            video.add(picture)

    def _read(self, crew: Crew, index: int) -> Callable[[], Pixels]:
        return crew.submit(partial(_coloured, self.reel.png(index))).result


def _missing(reels: Sequence[Reel], index: int) -> list[Reel]:
    return [reel for reel in reels if index < reel.count and not reel.has(index)]


def _videos(crew: Crew, reel: Reel, kinds: Sequence[str]) -> list[Video]:
    """Begin the videos of a reel that are not there yet."""
    paths = {kind: reel.video(kind) for kind in kinds}
    return [
        crew.video(path, partial(write_video, kind), reel.fps)
        for kind, path in paths.items()
        if not path.exists()
    ]


def _of(job: Future[Pictures], name: str) -> Pixels:
    return _in_colour(job.result()[name])


def _coloured(path: Path) -> Pixels:
    return _in_colour(read_image(path))


def _in_colour(pixels: Pixels) -> Pixels:
    return pixels if pixels.shape[2] == 3 else np.repeat(pixels, 3, axis=2)


def _warm_up(artist: Artist, shots: Sequence[Shot]) -> None:
    """Draw something small, so that loading kernels is not counted as drawing."""
    shot = replace(shots[0], camera=shots[0].camera.resized(16, 16))
    artist.draw(shot, shot)


def _room(shot: Shot, supersample: int) -> int:
    """Return how many frames may wait: rgb, alpha, depth and flow are seven floats a pixel."""
    size = 28 * shot.camera.width * shot.camera.height * supersample**2
    return max(2, min(MOST_ROOM, ROOM_BYTES // size))
