"""What a driver does where Ray behaves badly, with a Ray of the test's own."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gsdmsr_cli.calling import ray_calls
from gsdmsr_cli.calling.ray_calls import call_on_ray


class LosesInterrupts:
    """Tasks that run until they have been cancelled twice; Ctrl-C comes at the first look."""

    exceptions = SimpleNamespace(
        TaskCancelledError=InterruptedError, RayTaskError=ArithmeticError, RayError=OSError
    )

    def __init__(self, error: Exception | None = None) -> None:
        self.cancelled: list[Any] = []
        self._error, self._looks, self._tasks = error, 0, 0

    def remote(self, _function: Callable[..., Any]) -> Any:
        return SimpleNamespace(options=lambda **_: SimpleNamespace(remote=self._start))

    def _start(self, *_: Any) -> int:
        self._tasks += 1
        return self._tasks

    def wait(self, tasks: Sequence[int], timeout: float) -> tuple[list[int], list[int]]:
        assert timeout > 0
        self._looks += 1
        assert self._looks < 1_000_000, "waits without end"
        if self._looks == 1 and self._error:
            raise self._error
        if self._looks == 1:
            os.kill(os.getpid(), signal.SIGINT)
        done = [task for task in tasks if self.cancelled.count(task) >= 2]
        return done, [task for task in tasks if task not in done]

    def cancel(self, task: int) -> None:
        self.cancelled.append(task)

    def get(self, _task: int) -> tuple[str, int, str]:
        raise InterruptedError


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_calls, "_CANCEL_AGAIN_S", 0.02)


def call(ray: LosesInterrupts, folder: Path) -> None:
    works = {folder / name: lambda: iter([["--version"]]) for name in "ab"}
    call_on_ray(ray, works, 1, {}, lambda _: None)


def test_an_interrupt_that_is_lost_is_sent_again(tmp_path: Path) -> None:
    ray = LosesInterrupts()
    with pytest.raises(KeyboardInterrupt):
        call(ray, tmp_path)
    assert ray.cancelled == [1, 2, 1, 2]


def test_so_it_is_after_an_error(tmp_path: Path) -> None:
    ray = LosesInterrupts(ConnectionError("gone"))
    with pytest.raises(ConnectionError, match="gone"):
        call(ray, tmp_path)
    assert ray.cancelled == [1, 2, 1, 2]
