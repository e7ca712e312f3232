"""Draws all frames of a film and writes their files; frames whose files exist are kept.

One thread draws, and a pool of threads writes: files are compressed while the next frame is drawn.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.evaluation.protocol import ViewRenderer
from gsdmsr_cli.filming.buffers import BufferRenderer, Buffers, Floats
from gsdmsr_cli.filming.encode import write_video
from gsdmsr_cli.filming.output_files import OutputFiles
from gsdmsr_cli.filming.outputs import CHANNELS, ColourRange, numbers, picture
from gsdmsr_cli.filming.writers import VideoWriter, WriterPool
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.scene.film import Film, Shot
from gsdmsr_cli.scene.imaging import read_image, resize_area, write_exr, write_png

Pixels = NDArray[np.uint8]
Pictures = Mapping[str, Pixels]

WAITING_BYTES, MOST_WAITING = 512 << 20, 16
"""Memory for frames that wait to be written, and most such frames."""


@dataclass(frozen=True)
class Timings:
    """How many frames a film had, and how long they took.

    Attributes:
        drawn, kept: frames drawn, and those whose files existed already.
        drawing: time in which frames were drawn [s].
        elapsed: wall time from the first frame to the last file [s].
    """

    drawn: int
    kept: int
    drawing: float
    elapsed: float


def draw_film(
    renderer: ViewRenderer,
    film: Film,
    outputs: Sequence[OutputFiles],
    colours: ColourRange,
    videos: Sequence[str],
    supersample: int,
    on_progress: OnProgress,
) -> Timings:
    """Draw the frames of a film whose files are missing, and write pictures, numbers and videos.

    Args:
        renderer: the model, the engine and the true pictures.
        film: cameras and moments.
        outputs: the files of each output, prepared.
        colours: range of the colour maps.
        videos: kinds of videos; those that exist already are kept.
        supersample: each pixel is the mean of so many squared.
        on_progress: called with (frames done, frames in all).

    Raises:
        DataError: a file cannot be written, or a true picture not be read.
    """
    missing = [_missing(outputs, i) for i in range(len(film.shots))]
    buffer_renderer = BufferRenderer(renderer, supersample, [files.output for files in outputs])
    frame_writer = FrameWriter(renderer, supersample, colours)
    if any(missing):
        _warm_up(buffer_renderer, film.shots)
    drawing, started = 0.0, time.perf_counter()
    with WriterPool(_most_waiting(film.shots[0], supersample)) as pool:
        output_videos = [OutputVideos(files, _videos(pool, files, videos)) for files in outputs]
        for i, shot in enumerate(film.shots):
            job = None
            if missing[i]:
                following = film.shots[i + 1] if i + 1 < len(film.shots) else None
                before = time.perf_counter()
                buffers = buffer_renderer.draw(shot, following)
                drawing += time.perf_counter() - before
                job = pool.submit(partial(frame_writer.write, missing[i], i, shot, buffers))
            for output in output_videos:
                output.add(pool, i, job if output.files in missing[i] else None)
            on_progress(i + 1, len(film.shots))
    drawn, count = sum(map(bool, missing)), max(files.count for files in outputs)
    return Timings(drawn, count - drawn, drawing, time.perf_counter() - started)


@dataclass(frozen=True, eq=False)
class FrameWriter:
    """Turns buffers into files; called from many threads.

    Attributes:
        renderer: has the true pictures.
        supersample: factor by which buffers are larger than a picture on each side.
        colours: range of the colour maps.
    """

    renderer: ViewRenderer
    supersample: int
    colours: ColourRange

    def write(
        self, outputs: Sequence[OutputFiles], index: int, shot: Shot, drawn: Buffers
    ) -> Pictures:
        """Write the files of a frame, and return its pictures by the outputs' names."""
        buffers = drawn.shrunk(self.supersample)
        pictures = {}
        for files in outputs:
            true = self._true(shot) if files.output == "error" else None
            pixels = picture(files.output, buffers, self.colours, true)
            exr = files.exr(index)
            if exr is not None:
                write_exr(exr, numbers(files.output, buffers), CHANNELS[files.output])
            write_png(files.png(index), pixels)
            pictures[files.name] = pixels
        return pictures

    def _true(self, shot: Shot) -> Floats:
        """Return the true picture in the size of the shot."""
        assert shot.view is not None
        true = self.renderer.true(shot.view).numpy()
        camera = shot.camera
        if true.shape[:2] == (camera.height, camera.width):
            return true
        return resize_area(np.ascontiguousarray(true), camera.width, camera.height)


@dataclass(frozen=True, eq=False)
class OutputVideos:
    """The files of one output, and the videos that are being encoded from its pictures."""

    files: OutputFiles
    videos: list[VideoWriter]

    def add(self, pool: WriterPool, index: int, job: Future[Pictures] | None) -> None:
        """Add a frame to the videos: what ``job`` returns, or else what is on disk."""
        if not self.videos or index >= self.files.count:
            return
        picture = partial(_of, job, self.files.name) if job else self._read(pool, index)
        for video in self.videos:
            video.add(picture)

    def _read(self, pool: WriterPool, index: int) -> Callable[[], Pixels]:
        return pool.submit(partial(_read_rgb, self.files.png(index))).result


def _missing(outputs: Sequence[OutputFiles], index: int) -> list[OutputFiles]:
    return [files for files in outputs if index < files.count and not files.has(index)]


def _videos(pool: WriterPool, files: OutputFiles, kinds: Sequence[str]) -> list[VideoWriter]:
    """Begin the videos of an output that do not exist yet."""
    paths = {kind: files.video(kind) for kind in kinds}
    return [
        pool.video(path, partial(write_video, kind), files.fps)
        for kind, path in paths.items()
        if not path.exists()
    ]


def _of(job: Future[Pictures], name: str) -> Pixels:
    return _as_rgb(job.result()[name])


def _read_rgb(path: Path) -> Pixels:
    return _as_rgb(read_image(path))


def _as_rgb(pixels: Pixels) -> Pixels:
    return pixels if pixels.shape[2] == 3 else np.repeat(pixels, 3, axis=2)


def _warm_up(buffer_renderer: BufferRenderer, shots: Sequence[Shot]) -> None:
    """Draw something small, so that loading kernels is not counted as drawing."""
    shot = replace(shots[0], camera=shots[0].camera.resized(16, 16))
    buffer_renderer.draw(shot, shot)


def _most_waiting(shot: Shot, supersample: int) -> int:
    """Return how many frames may wait: rgb, alpha, depth and flow are seven floats a pixel."""
    size = 28 * shot.camera.width * shot.camera.height * supersample**2
    return max(2, min(MOST_WAITING, WAITING_BYTES // size))
