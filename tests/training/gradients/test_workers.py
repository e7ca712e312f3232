"""Workers: the same result as without, and nothing lost or left over when something goes wrong."""

from __future__ import annotations

import multiprocessing
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from training_checks import (
    SETTLING,
    STEPS,
    assert_same_tensors,
    copies,
    preset_of,
    run_of,
    trainer_of,
)

from gsdmsr_cli.backends.cpu import jit
from gsdmsr_cli.ground import plugins
from gsdmsr_cli.ground.errors import DataError, GsdmsrError
from gsdmsr_cli.model import motion as motions
from gsdmsr_cli.scene.block_store import BlockStore
from gsdmsr_cli.scene.native import cv2
from gsdmsr_cli.training.trainer import Trainer

every_motion = pytest.mark.parametrize("motion", plugins.names(motions.__name__))


@pytest.fixture(autouse=True)
def all_threads() -> Iterator[int]:
    before = jit.threads()
    yield jit.set_threads(0)
    jit.set_threads(before)


@pytest.fixture
def two_threads(all_threads: int) -> None:
    if all_threads < 2 or not sys.platform.startswith("linux") or not jit.may_fork():
        pytest.skip("workers need two threads, Linux, and kernels that run in a forked process")
    jit.set_threads(2)


def with_workers(data: Path, *options: str, motion: str = "multiscale") -> Trainer:
    trainer = trainer_of(data, preset_of(*options, motion=motion))
    trainer.start_workers(lambda: None)
    return trainer


@every_motion
@pytest.mark.parametrize("views", [2, 3])
@pytest.mark.usefixtures("two_threads")
def test_workers_change_no_result(tiny_scene: Path, motion: str, views: int) -> None:
    option = f"training.views_per_step={views}"
    alone = trainer_of(tiny_scene, preset_of(option, motion=motion))
    losses = [alone.step().loss for _ in range(STEPS)]
    with with_workers(tiny_scene, option, motion=motion) as assisted:
        assert len(assisted.workers) == 2
        assert [assisted.step().loss for _ in range(STEPS)] == losses
    assert len(assisted.model.splats) == 200  # it has grown on the way
    assert_same_tensors(copies(assisted.checkpoint().tensors), copies(alone.checkpoint().tensors))


@pytest.mark.usefixtures("two_threads")
def test_workers_know_who_stands_still(tiny_scene: Path) -> None:
    options = (*SETTLING, "training.views_per_step=2")
    alone = trainer_of(tiny_scene, preset_of(*options))
    losses = [alone.step().loss for _ in range(STEPS)]
    with with_workers(tiny_scene, *options) as assisted:
        assert [assisted.step().loss for _ in range(STEPS)] == losses
    assert 0 < assisted.model.moving < len(assisted.model.splats)
    assert_same_tensors(copies(assisted.checkpoint().tensors), copies(alone.checkpoint().tensors))


@pytest.mark.usefixtures("two_threads")
def test_workers_go_on_from_a_checkpoint(tiny_scene: Path, tmp_path: Path) -> None:
    option = "training.views_per_step=2"
    alone = trainer_of(tiny_scene, preset_of(option))
    for _ in range(STEPS // 2):
        alone.step()
    run = run_of(alone, tmp_path / "run")
    run.save(alone.checkpoint())
    losses = [alone.step().loss for _ in range(3)]
    with with_workers(tiny_scene, option) as assisted:
        assisted.step()
        assisted.restore(run.load())
        assert [assisted.step().loss for _ in range(3)] == losses


@pytest.mark.usefixtures("two_threads")
def test_processes_share_the_threads_and_end(tiny_scene: Path) -> None:
    with with_workers(tiny_scene, "training.views_per_step=2") as trainer:
        assert len(multiprocessing.active_children()) == 1
        assert jit.threads() == 1
    assert not multiprocessing.active_children()
    assert jit.threads() == 2
    assert len(trainer.workers) == 1
    trainer.step()  # alone


@pytest.mark.usefixtures("two_threads")
def test_one_view_needs_no_worker(tiny_scene: Path) -> None:
    with with_workers(tiny_scene, "training.views_per_step=1") as trainer:
        assert len(trainer.workers) == 1 and jit.threads() == 2


def test_one_thread_has_no_worker(tiny_scene: Path) -> None:
    jit.set_threads(1)
    with with_workers(tiny_scene, "training.views_per_step=2") as trainer:
        assert len(trainer.workers) == 1 and jit.threads() == 1


@pytest.mark.usefixtures("two_threads")
def test_a_worker_that_is_killed_ends_the_training_with_an_explanation(tiny_scene: Path) -> None:
    with with_workers(tiny_scene, "training.views_per_step=2") as trainer:
        trainer.step()
        multiprocessing.active_children()[0].kill()
        with pytest.raises(GsdmsrError, match=r"worker process .* ended \(exit code -9\)"):
            trainer.step()


@pytest.mark.usefixtures("two_threads")
def test_what_goes_wrong_in_a_worker_is_told_here(tiny_scene: Path) -> None:
    options = "training.views_per_step=2", "training.low_resolution_until=0"
    trainer = trainer_of(tiny_scene, preset_of(*options))
    trainer.renderer.pictures.store = BlockStore(0)  # pictures are decoded when they are needed
    with trainer:
        trainer.start_workers(lambda: None)
        trainer.step()
        first, second = trainer.queue[-1], trainer.queue[-2]  # the second is the worker's
        path = trainer.views[second].image_path
        assert trainer.views[first].image_path != path
        content = path.read_bytes()
        path.unlink()
        try:
            with pytest.raises(DataError, match=path.name):
                trainer.step()
        finally:
            path.write_bytes(content)


@pytest.mark.usefixtures("two_threads")
def test_a_worker_that_cannot_prepare_says_so(tiny_scene: Path) -> None:
    def fail() -> None:
        raise DataError("no such thing")

    trainer = trainer_of(tiny_scene, preset_of("training.views_per_step=2"))
    with trainer:
        trainer.start_workers(fail)
        with pytest.raises(DataError, match="no such thing"):
            trainer.workers.wait()


@pytest.mark.usefixtures("two_threads")
def test_workers_use_opencv_whose_threads_do_not_come_along(tiny_scene: Path) -> None:
    picture, before = np.zeros((2000, 2000, 3), np.uint8), cv2.getNumThreads()

    def use() -> None:
        signal.alarm(20)  # ends a worker that waits for threads which it does not have
        cv2.setNumThreads(1)
        cv2.GaussianBlur(picture, (9, 9), 0)

    cv2.setNumThreads(4)
    try:
        cv2.GaussianBlur(picture, (9, 9), 0)  # starts the threads
        with trainer_of(tiny_scene, preset_of("training.views_per_step=2")) as trainer:
            trainer.start_workers(use)
            assert len(trainer.workers) == 2
            trainer.workers.wait()
            assert cv2.getNumThreads() == 4
    finally:
        cv2.setNumThreads(before)
