"""A short stream on a small rig, for tests of its trainer, its loop and its run folder."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from statistics import fmean

from gsdmsr_cli.drawing.splatting import draw
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.options.preset import Preset, load_preset
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.training.streaming.trainer import StreamTrainer

FIRST, EACH, MOMENTS = 24, 8, 4
"""Steps of the first moment and of each later one, and how many moments there are."""

OPTIONS = (
    f"training.steps={FIRST}", f"stream.steps={EACH}", "training.average_from=0.5",
    "splats.count=150", "splats.start=box", "stream.keyframe_every=2", "stream.samples=64",
    "density.start=4", "density.every=4", "density.until=0.8", "density.gradient=1e-7",
    "density.cap=220", "data.background=white", "training.low_resolution_until=0.2",
    "layers=[{name: exposure}]",
)  # fmt: skip


WAYS = "persistent", "hicom", "scale-gs", "3dgstream"
"""Presets of streams."""

NEWCOMERS = "layers=[{name: exposure}, {name: newcomers, count: 30}]"
"""Splats for what is new, beside the layer that presets of streams have."""


def preset_of(*options: str, way: str = WAYS[0]) -> Preset:
    return load_preset(way, None, [*OPTIONS, *options])


def stream_trainer(data: Path, *options: str, way: str = WAYS[0]) -> StreamTrainer:
    preset = preset_of(*options, way=way)
    pictures = Pictures((1.0, 1.0, 1.0), 1, 1 << 24)
    return StreamTrainer(read_scene(data), preset, best_engine("cpu"), pictures)


def each_moment(trainer: StreamTrainer) -> Iterator[int]:
    """Train the present moment and all later ones, and yield the number of each as it is over."""
    while True:
        while trainer.clock.progress < 1:
            trainer.step()
        trainer.settle()
        yield trainer.clock.moment
        if trainer.clock.moment == len(trainer.shots) - 1:
            return
        trainer.begin_next()


def through(trainer: StreamTrainer, moments: int) -> None:
    """Train the present moment and later ones, until so many are over."""
    for moment in each_moment(trainer):
        if moment == moments - 1:
            return


def psnr_of(trainer: StreamTrainer) -> float:
    """Return the mean PSNR of the test views of the present moment [dB]."""
    renderer, found = trainer.renderer, []
    for view in trainer.scene.split("test"):
        if view.time == trainer.shot.time:
            given = renderer.engine, renderer.background
            rgb = draw(trainer.model, view.camera, view.time, *given).rgb.detach().clamp(0, 1)
            true = renderer.pictures.load(view).permute(1, 2, 0) / 255
            found.append(float(-10 * (rgb - true).square().mean().log10()))
    return fmean(found)
