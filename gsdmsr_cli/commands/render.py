"""gsdmsr render: draws a run to pictures and a video."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

from gsdmsr_cli.camera import Camera
from gsdmsr_cli.commands._progress import Tell, progress_bar
from gsdmsr_cli.commands._trained import Trained, open_trained
from gsdmsr_cli.errors import DataError, UsageError
from gsdmsr_cli.evaluation.metrics import quantize
from gsdmsr_cli.imaging import write_png, write_webm
from gsdmsr_cli.paths import orbit
from gsdmsr_cli.splatting import draw

ORBIT_FRAMES = 120
ORBIT_FPS, TEST_FPS = 30.0, 10.0


@dataclass(frozen=True, eq=False)
class Film:
    """What one path shows.

    Attributes:
        name: of the path; the pictures go to a folder and the video to a file of that name.
        shots: camera and time of every frame.
        fps: frames a second of the video.
    """

    name: str
    shots: list[tuple[Camera, float]]
    fps: float


def run(
    run_folder: Path,
    path: str | None,
    frames: int | None,
    out: Path | None,
    data: Path | None = None,
) -> None:
    """Write ``PATH/0000.png`` and so on, and ``PATH.webm``, to ``out`` or else ``RUN/render``.

    Args:
        run_folder: the run.
        path: "test" for the test views in the order of time, "orbit" for a circle round the scene
            while time goes from 0 to 1, or None for both.
        frames: number of frames of the orbit.
        out: folder to write.
        data: where the data lies now, if not where it lay in training.

    Raises:
        UsageError: a number of frames for the test views.
        DataError: the run or its data cannot be used, or a file not be written.
    """
    if path == "test" and frames is not None:
        raise UsageError("--frames is for --path orbit; the test views are as many as there are")
    trained = open_trained(run_folder, data)
    films = []
    if path in (None, "test"):
        films.append(_test(trained))
    if path in (None, "orbit"):
        films.append(_orbit(trained, frames or ORBIT_FRAMES))
    target = out or run_folder / "render"
    for film in films:
        _make_room(target / film.name, len(film.shots), ours=out is None)
    for film in films:
        with progress_bar(f"drawing {film.name}") as tell:
            pictures = _draw(trained, film, target / film.name, tell)
            write_webm(target / f"{film.name}.webm", pictures, film.fps)
        text = f"wrote {target / film.name}.webm and {len(film.shots)} pictures beside it"
        Console().out(text, highlight=False)


def _test(trained: Trained) -> Film:
    views = sorted(trained.scene.split("test"), key=lambda view: view.time)
    pictures = trained.studio.pictures
    return Film("test", [(pictures.camera(view), view.time) for view in views], TEST_FPS)


def _orbit(trained: Trained, count: int) -> Film:
    # formats place what is to be reconstructed round the world's origin, see Scene.bound
    cameras = [trained.studio.pictures.camera(view) for view in trained.scene.split("train")]
    moments = [i / max(count - 1, 1) for i in range(count)]
    around = orbit(cameras, np.zeros(3), count)
    return Film("orbit", list(zip(around, moments, strict=True)), ORBIT_FPS)


def _make_room(folder: Path, count: int, ours: bool) -> None:
    """Make the folder, without pictures of an earlier and longer film.

    Raises:
        DataError: there are such pictures in a folder that is not ``ours`` to clear, or the folder
            cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        numbered = [path for path in folder.iterdir() if re.fullmatch(r"\d{4,}\.png", path.name)]
    except OSError as error:
        raise DataError(f"{folder}: cannot be written: {error.strerror or error}") from error
    left = sorted(path for path in numbered if int(path.stem) >= count)
    if left and not ours:
        raise DataError(
            f"{folder}: holds {len(left)} pictures of a longer film, {left[0].name} the first; "
            "empty it or choose another --out"
        )
    for path in left:
        path.unlink()


@torch.no_grad()
def _draw(trained: Trained, film: Film, folder: Path, tell: Tell) -> Iterator[NDArray[np.uint8]]:
    """Draw, write and yield every frame."""
    studio = trained.studio
    for index, (camera, moment) in enumerate(film.shots):
        frame = draw(studio.model, camera, moment, studio.engine, studio.background)
        pixels = (quantize(frame.rgb) * 255).round().to(torch.uint8).numpy(force=True)
        write_png(folder / f"{index:04d}.png", pixels)
        tell(index + 1, len(film.shots))
        yield pixels
