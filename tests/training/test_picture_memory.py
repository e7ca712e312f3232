"""The pictures of a training and its workers stay within ``data.cache_mib``, all together."""

from __future__ import annotations

import gc
import multiprocessing
import os
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from datasets import dnerf_frames, write_json, write_picture
from training_checks import preset_of

from gsdmsr_cli.backends.cpu import jit
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.training.gradients.phase import Order, Phase
from gsdmsr_cli.training.trainer import Trainer

SIDE, VIEWS = 800, 20

WHOLE_MIB, HALVED_MIB = 36.9, 9.4
"""Memory of all pictures and of all their halves, in whole blocks."""

SLACK_MIB = 5.0
"""For what else grows while all views are looked at: 0.2 to 0.4 in a process of its own, 2.1 after
the other tests, since pages that processes share are copied when one of them writes there."""

SHARES = Path("/proc/self/smaps_rollup")

HALVED, WHOLE = Phase(0.0, moving=False), Phase(0.9, moving=False)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("scene")
    for split, count in (("train", VIEWS), ("val", 1), ("test", 1)):
        frames = dnerf_frames(split, count)
        for i, frame in enumerate(frames):
            picture = np.full((SIDE, SIDE, 3), 8 * i, np.uint8)
            write_picture(folder / f"{frame['file_path']}.png", picture)
        write_json(folder / f"transforms_{split}.json", {"camera_angle_x": 0.7, "frames": frames})
    return folder


@pytest.fixture
def two_threads() -> Iterator[None]:
    before = jit.threads()
    most = jit.set_threads(0)
    if most < 2 or not sys.platform.startswith("linux") or not jit.may_fork():
        pytest.skip("workers need two threads, Linux, and kernels that run in a forked process")
    if not SHARES.is_file() or "Pss_Shmem" not in _kib(SHARES):
        pytest.skip(f"the system does not tell what processes share ({SHARES})")
    jit.set_threads(2)
    yield
    jit.set_threads(before)


def resident_mib() -> float:
    """Return the memory of this process and its workers, what they share counted once [MiB].

    Without mapped files: a share of those goes to whatever other process maps them too.
    """
    gc.collect()
    pids = [os.getpid(), *(child.pid for child in multiprocessing.active_children())]
    found = [_kib(Path(f"/proc/{pid}/smaps_rollup")) for pid in pids]
    return sum(one["Pss_Anon"] + one["Pss_Shmem"] for one in found) / 1024


def _kib(path: Path) -> dict[str, int]:
    rows = (line.split() for line in path.read_text(encoding="ascii").splitlines()[1:])
    return {name.rstrip(":"): int(size) for name, size, *_ in rows}


def look_at(trainer: Trainer, views: range, phase: Phase) -> None:
    """Let each of two processes look at every one of the views."""
    for first in views:
        second = views[(first + 1) % len(views)]
        for rows in ((first, second), (second, first)):
            orders = [Order(row) for row in rows]
            trainer.workers.gradients(trainer.model, orders, phase, lambda: None)


@pytest.mark.usefixtures("two_threads")
@pytest.mark.parametrize("limit_mib", [0, 16, 128])
def test_pictures_of_all_processes_stay_within_the_limit(scene: Path, limit_mib: int) -> None:
    # without a window no picture is read before the first look
    options = "training.views_per_step=2", "training.low_resolution_until=0.5", "training.window=1"
    pictures = Pictures((1.0, 1.0, 1.0), 1, limit_mib << 20)
    trainer = Trainer(read_scene(scene), preset_of(*options), best_engine("cpu"), pictures)
    # all cameras once with their own pictures and once with the same one, to tell the memory of
    # pictures from what else a process keeps for further looks
    own = trainer.views
    first = own[0].image_path
    alike = [replace(view, name=f"{view.name}, alike", image_path=first) for view in own]
    trainer.renderer.views = [*own, *alike]
    gc.collect()
    gc.freeze()  # a collection would copy what processes share until they write it
    with trainer:
        trainer.start_workers(lambda: None)
        assert len(trainer.workers) == 2
        for stage in (HALVED, WHOLE):
            look_at(trainer, range(VIEWS, 2 * VIEWS), stage)
        before = resident_mib()
        look_at(trainer, range(VIEWS), HALVED)
        halved = resident_mib() - before
        look_at(trainer, range(VIEWS), WHOLE)
        whole = resident_mib() - before
    gc.unfreeze()
    for grown, needed in ((halved, WHOLE_MIB + HALVED_MIB), (whole, WHOLE_MIB)):
        assert grown < min(limit_mib, needed) + SLACK_MIB
    assert whole > min(limit_mib, WHOLE_MIB) / 2  # it does use the limit
