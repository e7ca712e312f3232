"""Writes a large capture and measures how long it takes to be read, and in how much memory."""

from __future__ import annotations

import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground import machine
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.imaging import write_png
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.training.trainer import Trainer

SIZE = 160, 90
"""Of each picture [px]."""

CACHE_MIB = 256
"""Memory for decoded pictures; 10,000 of this size are 412 MiB."""

_TRACK = 4
"""Observations of a point."""

_CHUNK = 100_000


@dataclass(frozen=True)
class Phase:
    """A part of the work before the first step of a training.

    Attributes:
        what: its name.
        seconds: its wall time.
        peak_mib: the most memory that this process has held by its end.
    """

    what: str
    seconds: float
    peak_mib: float | None


def write_capture(folder: Path, pictures: int, points: int, on_progress: OnProgress) -> None:
    """Write a COLMAP model, binary, of cameras on a circle round a ball of points, with pictures.

    The pictures are noise, each file different. Nothing large is held in memory.
    """
    model, images = folder / "sparse" / "0", folder / "images"
    model.mkdir(parents=True)
    images.mkdir()
    random = np.random.default_rng(0)
    width, height = SIZE
    camera = struct.pack("<QiiQQ4d", 1, 1, 1, width, height, 100.0, 100.0, width / 2, height / 2)
    (model / "cameras.bin").write_bytes(camera)
    with (model / "images.bin").open("wb") as file:
        file.write(struct.pack("<Q", pictures))
        for i in range(pictures):
            name = f"{i:05d}.png"
            file.write(struct.pack("<i7di", i + 1, *_pose(i / pictures), 1))
            file.write(name.encode() + b"\0" + struct.pack("<Q", 0))
            write_png(images / name, random.integers(0, 256, (height, width, 3), dtype=np.uint8))
            on_progress(i + 1, pictures)
    with (model / "points3D.bin").open("wb") as file:
        file.write(struct.pack("<Q", points))
        for first in range(0, points, _CHUNK):
            file.write(_points(min(_CHUNK, points - first), random))


def _pose(turn: float) -> tuple[float, ...]:
    """Return qw qx qy qz tx ty tz of a camera that looks at the origin from 4 units away."""
    half = np.pi * turn
    return float(np.cos(half)), 0.0, float(np.sin(half)), 0.0, 0.0, 0.0, 4.0


def _points(count: int, random: np.random.Generator) -> bytes:
    layout = [("id", "<u8"), ("place", "<f8", 3), ("colour", "u1", 3), ("error", "<f8")]
    rows = np.zeros(count, [*layout, ("length", "<u8"), ("track", "<i4", (_TRACK, 2))])
    rows["place"] = random.normal(0, 0.5, (count, 3))
    rows["colour"] = random.integers(0, 256, (count, 3))
    rows["length"] = _TRACK
    return rows.tobytes()


def measure(folder: Path) -> Iterator[Phase]:
    """Read a capture as a training does and yield what each phase took, when it has ended.

    Raises:
        DataError: it cannot be read.
    """
    scene, phase = _timed("the model and the sizes of the pictures", lambda: read_scene(folder))
    yield phase
    options = load_preset("video", None, [f"data.cache_mib={CACHE_MIB}"])
    pictures = Pictures((0.0, 0.0, 0.0), 1, CACHE_MIB << 20)
    yield _timed("pictures, as far as the memory for them goes",
                 lambda: pictures.preload(scene.split("train")))[1]  # fmt: skip
    given = scene, options, best_engine("cpu"), pictures
    trainer, phase = _timed("the first splats", lambda: Trainer(*given))
    with trainer:
        yield phase


def _timed(what: str, work: Callable[[], Any]) -> tuple[Any, Phase]:
    began = time.perf_counter()
    result = work()
    return result, Phase(what, time.perf_counter() - began, machine.peak_rss_mib())
