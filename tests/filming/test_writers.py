"""Threads that write: in order, within bounds, and with nothing left half written."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from gsdmsr_cli.filming.writers import WriterPool
from gsdmsr_cli.ground.files import replacing


def write(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    """A video of one byte a picture."""
    with replacing(path) as beside:
        beside.write_bytes(b"")
        for picture in pictures:
            with beside.open("ab") as file:
                file.write(bytes([picture.flat[0], round(fps)]))


def pixel(value: int) -> np.ndarray:
    return np.full((1, 1, 3), value, np.uint8)


def test_videos_are_in_order_whatever_the_order_of_the_jobs(tmp_path: Path) -> None:
    def job(i: int) -> np.ndarray:
        time.sleep(0.02 if i % 3 == 0 else 0)
        return pixel(i)

    with WriterPool(most_jobs=3) as pool:
        videos = [pool.video(tmp_path / name, write, 25) for name in ("a", "b")]
        for i in range(20):
            future = pool.submit(lambda i=i: job(i))
            for video in videos:
                video.add(future.result)
    for name in ("a", "b"):
        assert (tmp_path / name).read_bytes() == bytes(x for i in range(20) for x in (i, 25))
    assert len(list(tmp_path.iterdir())) == 2


def test_there_are_so_many_jobs_and_no_more() -> None:
    gate, begun = threading.Event(), []

    def job() -> None:
        begun.append(threading.get_ident())
        gate.wait(10)

    with WriterPool(most_jobs=2) as pool:
        pool.submit(job)
        pool.submit(job)
        late = threading.Thread(target=pool.submit, args=(job,))
        late.start()
        late.join(0.2)
        assert late.is_alive()  # it waits until a job ends
        gate.set()
        late.join(10)
        assert not late.is_alive()
    assert len(begun) == 3


def test_a_video_that_is_slow_holds_the_drawing_up_at_its_bound(tmp_path: Path) -> None:
    gate = threading.Event()

    def slow(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
        gate.wait(10)
        write(path, pictures, fps)

    with WriterPool(most_jobs=2) as pool:
        video = pool.video(tmp_path / "a", slow, 1)
        video.add(lambda: pixel(0))
        video.add(lambda: pixel(1))
        late = threading.Thread(target=video.add, args=(lambda: pixel(2),))
        late.start()
        late.join(0.3)
        assert late.is_alive()
        gate.set()
        late.join(10)
    assert (tmp_path / "a").read_bytes() == bytes([0, 1, 1, 1, 2, 1])


def fail() -> np.ndarray:
    raise OSError("the disk is full")


def test_what_a_job_raises_is_raised_where_frames_are_drawn(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="the disk is full"), WriterPool(most_jobs=2) as pool:
        video = pool.video(tmp_path / "a", write, 1)
        for _ in range(100):
            video.add(pool.submit(fail).result)
            time.sleep(0.01)
        pytest.fail("it goes on")
    assert list(tmp_path.iterdir()) == []


def test_what_the_last_job_raises_is_not_lost() -> None:
    with pytest.raises(OSError, match="the disk is full"), WriterPool(most_jobs=2) as pool:
        pool.submit(fail)


@pytest.mark.parametrize("when", ["at once", "at the end"])
def test_what_a_video_raises_is_raised_where_frames_are_drawn(tmp_path: Path, when: str) -> None:
    def broken(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
        if when == "at the end":
            list(pictures)
        raise OSError("no encoder")

    with pytest.raises(OSError, match="no encoder"), WriterPool(most_jobs=2) as pool:
        video = pool.video(tmp_path / "a", broken, 1)
        for i in range(10):
            video.add(lambda i=i: pixel(i))
            time.sleep(0.01)
        if when == "at once":
            pytest.fail("it goes on")


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_an_interruption_finishes_what_is_being_written_and_drops_the_rest(
    tmp_path: Path, error: type[BaseException]
) -> None:
    begun, gate = threading.Event(), threading.Event()
    done: list[int] = []

    def job(i: int) -> np.ndarray:
        begun.set()
        gate.wait(10)
        done.append(i)
        return pixel(i)

    with pytest.raises(error), WriterPool(most_jobs=64) as pool:
        video = pool.video(tmp_path / "a", write, 1)
        for i in range(64):
            video.add(pool.submit(lambda i=i: job(i)).result)
        assert begun.wait(10)
        threading.Timer(0.2, gate.set).start()
        raise error
    assert 0 < len(done) < 64
    assert list(tmp_path.iterdir()) == []
    assert not [t for t in threading.enumerate() if t.name.startswith(("write", "video"))]
