"""Opens a trained run with its model and its data, for eval and render."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from gsdmsr_cli import raster
from gsdmsr_cli.drawing.any_size import at_any_size, focal_of
from gsdmsr_cli.evaluation.protocol import ViewRenderer
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.locks import one_of_readers
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.options.preset import BACKGROUNDS
from gsdmsr_cli.runs import moments
from gsdmsr_cli.runs.checkpoints import Checkpoint
from gsdmsr_cli.runs.run import Run, open_with_model
from gsdmsr_cli.runs.seen_pictures import check_whole
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene


@dataclass(frozen=True, eq=False)
class Trained:
    """A run ready to be drawn.

    Attributes:
        run: the folder.
        checkpoint: its last checkpoint.
        scene: the data that it was trained on.
        renderer: its model and all that draws it.
        device: where it is drawn, "cpu" or "cuda".
    """

    run: Run
    checkpoint: Checkpoint
    scene: Scene
    renderer: ViewRenderer
    device: str


@contextmanager
def open_trained(
    folder: Path,
    data: Path | None,
    background: str | None = None,
    downscale: int | None = None,
    verify: bool = False,
) -> Iterator[Trained]:
    """Open a run with its data, which nobody replaces until the end of the block.

    Args:
        folder: the run folder.
        data: where the data lies now, if not where it lay in training.
        background: "white" or "black", if not the one of training.
        downscale: divisor of the pictures' sides, if not the one of training.
        verify: whether every byte of the pictures must be as it was in training.

    Raises:
        DataError: the run or its data cannot be used, or do not belong together.
    """
    run, model, checkpoint = open_with_model(folder)
    place = _place_of_data(run, data)
    with one_of_readers(place):
        scene = run.part_of(read_scene(place))
        if verify:
            check_whole(run.root, scene)
        renderer, device = _renderer(run, model, scene, background, downscale)
        yield Trained(run, checkpoint, _so_far(run, scene), renderer, device)


def _so_far(run: Run, scene: Scene) -> Scene:
    """Return a scene without what is later than the last moment of a stream that goes on."""
    if not run.has_moments:
        return scene
    count, times = len(moments.there(run.root)), scene.train_times
    if count == len(times):
        return scene
    last = float(moments.read(run.root, moments.there(run.root)[-1]).about["time"])
    say.note(f"{count} of {len(times)} moments are there; views of later times are left out")
    return replace(scene, views=tuple(view for view in scene.views if view.time <= last))


def _renderer(
    run: Run, model: Model, scene: Scene, background: str | None, downscale: int | None
) -> tuple[ViewRenderer, str]:
    """Return what draws a model, at whatever size, and where."""
    # torch's own threads would wait busily between its small operations and take the kernels' cores
    torch.set_num_threads(1)
    options = run.preset.data
    colour = BACKGROUNDS[background or options.background]
    pictures = Pictures(colour, downscale or options.downscale, options.cache_mib << 20)
    device = raster.pick_device("auto")
    focals = [focal_of(view.camera) / options.downscale for view in scene.split("train")]
    engine = at_any_size(raster.best_engine(device), focals)
    behind = torch.tensor(colour).to(device)
    return ViewRenderer(model.to(device), engine, pictures, behind), device


def _place_of_data(run: Run, data: Path | None) -> Path:
    """Return the folder of a run's data; raise DataError if it is not where it was."""
    place = data or run.data
    if place is None:
        raise DataError(
            f"{run.root}: does not say where the data lies that it was trained on; say so with "
            "--data"
        )
    if data is None and not place.is_dir():
        raise DataError(
            f"{place}: the data that {run.root} was trained on is not there any more; "
            "say with --data where it is"
        )
    return place
