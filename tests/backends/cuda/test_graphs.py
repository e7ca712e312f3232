"""CUDA graphs of launches whose arguments change, by stand-ins for driver and capture."""

from __future__ import annotations

import ctypes
import gc
import threading
from contextlib import nullcontext
from typing import Any

import pytest
import torch

from gsdmsr_cli.backends.cuda import graphs, launch, recording
from gsdmsr_cli.ground.errors import GsdmsrError

CARD = torch.device("cuda", 1)
EXECUTE = "execute"


class Capture:
    """Stands in for ``torch.cuda.CUDAGraph``."""

    log: list[str] = []  # noqa: RUF012  (cleared by the fixture)

    def __init__(self, keep_graph: bool = False) -> None:
        self.keeps = keep_graph

    def capture_begin(self, pool: Any = None, capture_error_mode: str = "global") -> None:
        self.log.append(f"begin {pool}")

    def capture_end(self) -> None:
        self.log.append("end")

    def raw_cuda_graph(self) -> int:
        assert self.keeps
        return 6_000_000_000_000


class Stream:
    def __init__(self, device: object = None) -> None: ...

    def wait_stream(self, other: object) -> None:
        Capture.log.append("wait")


@pytest.fixture
def recorder(fake: ctypes.CDLL, monkeypatch: pytest.MonkeyPatch) -> graphs.GraphRecorder:
    monkeypatch.setattr(torch.cuda, "CUDAGraph", Capture)
    monkeypatch.setattr(torch.cuda, "Stream", Stream)
    monkeypatch.setattr(torch.cuda, "stream", lambda stream: nullcontext())
    monkeypatch.setattr(torch.cuda, "current_stream", Stream)
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: "pool")
    main = threading.current_thread()
    monkeypatch.setattr(
        torch.cuda, "is_current_stream_capturing", lambda: threading.current_thread() is main
    )
    zeros = torch.zeros
    monkeypatch.setattr(torch, "zeros", lambda *size, device=None, **more: zeros(*size, **more))
    made = graphs.GraphRecorder(CARD)
    Capture.log.clear()
    return made


def seen(fake: ctypes.CDLL) -> list[str]:
    return fake.take_log().decode().split(";")[:-1]


class Work:
    """A launch whose structure differs, and one whose does not."""

    def __init__(self) -> None:
        self.out, self.also = torch.zeros(2), torch.zeros(2)
        self.done = 0

    def __call__(self) -> torch.Tensor:
        self.done += 1
        three = launch.struct(self.out, 2, 2.0)
        recording.vary(three, lambda three, value: setattr(three, "member2", value))
        launch.launch("some", "fill", (5, 3), 128, three, self.also, 10.0, on=CARD)
        same = launch.struct(self.out, 2, 3.0)
        launch.launch("some", "fill", (1, 1), 32, same, self.also, 1.0, on=CARD)
        return self.out


def test_a_replay_gives_new_arguments_to_those_launches_that_differ(
    recorder: graphs.GraphRecorder, fake: ctypes.CDLL
) -> None:
    work = Work()
    made = recorder.record(work, 2.0)
    anchor = ["begin pool", "end"]  # which holds the pool
    assert Capture.log == [*anchor, "wait", "wait", "begin pool", "end"]
    assert work.done == 2  # once to warm up
    told = seen(fake)
    assert told.count("ask") == 1 and told[-1] == "instantiate"
    assert made.replay(4.5) is work.out
    shape = "5 3 1 128 1 1 0"
    assert [what for what in seen(fake) if what != "enter"] == [
        f"give 1 1 1 {shape} 4.5 10 0", EXECUTE
    ]  # fmt: skip
    made.replay(0.5)
    assert f"give 1 1 1 {shape} 0.5 10 0" in seen(fake)
    del made
    gc.collect()
    assert seen(fake) == ["destroy"]


def test_work_that_reads_something_else_than_its_inputs_is_refused(
    recorder: graphs.GraphRecorder,
) -> None:
    with pytest.raises(ValueError, match="differs from what inputs make of it"):
        recorder.record(Work(), 2.5)
    assert Capture.log[-1] == "end"


def test_no_garbage_is_collected_while_a_stream_is_captured(
    recorder: graphs.GraphRecorder,
) -> None:
    found = []
    recorder.record(lambda: found.append(gc.isenabled()), None)
    assert found == [True, False] and gc.isenabled()


def test_what_another_thread_does_meanwhile_is_no_part_of_it(
    recorder: graphs.GraphRecorder, fake: ctypes.CDLL
) -> None:
    """Such as drawing what a page shows."""
    beside = Work()

    def work() -> None:
        thread = threading.Thread(target=beside)
        thread.start()
        thread.join()

    made = recorder.record(work, 7.0)  # which is not what the other thread's structure holds
    assert beside.done == 2 and "ask" not in seen(fake)
    made.replay(8.0)
    assert [what for what in seen(fake) if what != "enter"] == [EXECUTE]


def test_an_error_of_the_work_is_told_and_not_that_of_the_capture(
    recorder: graphs.GraphRecorder, monkeypatch: pytest.MonkeyPatch
) -> None:
    def end(self: Capture) -> None:
        raise RuntimeError("operation failed due to a previous error during capture")

    def work() -> None:
        if not recording.is_recording():
            return
        raise GsdmsrError("what was wrong")

    recorder.record(lambda: None, None)
    monkeypatch.setattr(Capture, "capture_end", end)
    with pytest.raises(GsdmsrError, match="what was wrong"):
        recorder.record(work, None)
    assert gc.isenabled() and not recording.is_recording()


def test_what_is_followed_is_asked_before_and_told_after_a_replay(
    recorder: graphs.GraphRecorder,
) -> None:
    class Followed:
        good, told = True, 0

        def is_good(self) -> bool:
            return self.good

        def replayed(self) -> None:
            self.told += 1

    followed, kept = Followed(), torch.zeros(1)

    def work() -> None:
        recording.follow(followed)
        recording.keep(kept)

    made = recorder.record(work, None)
    assert made.is_good()
    made.replay(None)
    assert followed.told == 1
    followed.good = False
    assert not made.is_good()
