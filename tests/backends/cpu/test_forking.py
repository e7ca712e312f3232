"""Work that is done by forks of a process: answers, errors, ends of either side."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest

from gsdmsr_cli.backends.cpu.forking import Forks

CODE = """
import os, sys, time
from pathlib import Path
from gsdmsr_cli.backends.cpu import forking

forking.IDLE_SECONDS = float(os.environ.get("IDLE", "10"))
done = []

def work(given):
    folder, name = given.decode().split(" ")
    done.append(name)
    if name == "fails":
        raise ValueError(name)
    if name == "sleeps":
        Path(folder, "asleep").write_text(str(os.getpid()))
        time.sleep(60)
    about = [str(os.getpid()), str(os.getppid()), " ".join(done), os.environ.get("MARK", "")]
    Path(folder, name).write_text("\\n".join(about))

forking.serve(work)
"""


@pytest.fixture
def forks() -> Iterator[Forks]:
    made = Forks(CODE)
    yield made
    made._stop()


def environment(**more: str) -> Mapping[str, str]:
    return os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)} | more


def about(path: Path) -> list[str]:
    return path.read_text(encoding="utf-8").split("\n")


def test_each_piece_has_a_process_that_knows_of_no_other(forks: Forks, tmp_path: Path) -> None:
    for name in ("one", "two", "three"):
        assert forks.do(f"{tmp_path} {name}".encode(), environment())
    found = [about(tmp_path / name) for name in ("one", "two", "three")]
    assert [done for _, _, done, _ in found] == ["one", "two", "three"]
    assert len({pid for pid, *_ in found}) == 3
    assert len({parent for _, parent, *_ in found}) == 1


def test_work_that_fails_is_told_and_does_no_harm_to_the_next(forks: Forks, tmp_path: Path) -> None:
    assert not forks.do(f"{tmp_path} fails".encode(), environment())
    assert forks.do(f"{tmp_path} one".encode(), environment())


def test_another_environment_is_that_of_the_work(forks: Forks, tmp_path: Path) -> None:
    for mark in ("first", "second"):
        assert forks.do(f"{tmp_path} {mark}".encode(), environment(MARK=mark))
        assert about(tmp_path / mark)[3] == mark


def test_a_process_that_was_killed_is_replaced(forks: Forks, tmp_path: Path) -> None:
    assert forks.do(f"{tmp_path} one".encode(), environment())
    os.kill(int(about(tmp_path / "one")[1]), signal.SIGKILL)
    assert forks.do(f"{tmp_path} two".encode(), environment())


def test_a_process_without_work_ends_and_is_replaced(forks: Forks, tmp_path: Path) -> None:
    assert forks.do(f"{tmp_path} one".encode(), environment(IDLE="0.1"))
    assert forks._process is not None
    forks._process.wait(timeout=30)
    assert forks.do(f"{tmp_path} two".encode(), environment(IDLE="0.1"))


def test_work_that_is_given_up_leaves_no_answer_behind(forks: Forks, tmp_path: Path) -> None:
    class EnoughError(Exception):
        """What a signal's handler raises."""

    def give_up(*_: object) -> None:
        raise EnoughError

    before = signal.signal(signal.SIGALRM, give_up)
    try:
        signal.setitimer(signal.ITIMER_REAL, 1.0)
        started = time.monotonic()
        with pytest.raises(EnoughError):
            forks.do(f"{tmp_path} sleeps".encode(), environment())
        assert time.monotonic() - started < 30
    finally:
        signal.signal(signal.SIGALRM, before)
    assert not forks.do(f"{tmp_path} fails".encode(), environment())
    assert forks.do(f"{tmp_path} one".encode(), environment())


ASKER = """
import os, sys
from gsdmsr_cli.backends.cpu.forking import Forks

Forks(sys.argv[1]).do(f"{sys.argv[2]} sleeps".encode(), os.environ)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes cannot be forked here")
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGINT], ids=["killed", "interrupted"])
def test_work_ends_with_who_has_asked_for_it(tmp_path: Path, end: signal.Signals) -> None:
    command = [sys.executable, "-c", ASKER, CODE, str(tmp_path)]
    with subprocess.Popen(
        command,
        env=environment(),
        stderr=subprocess.DEVNULL,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # as in the foreground
    ) as asker:
        asleep = tmp_path / "asleep"
        wait_until(lambda: asleep.exists() and asleep.read_text() != "")
        asker.send_signal(end)
        asker.wait(timeout=20)
        wait_until(lambda: not is_running(int(asleep.read_text())))


def is_running(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def wait_until(holds: Callable[[], bool], seconds: float = 20.0) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.02)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes cannot be forked here")
def test_a_fork_of_this_process_starts_its_own(forks: Forks, tmp_path: Path) -> None:
    assert forks.do(f"{tmp_path} one".encode(), environment())
    pid = os.fork()
    if not pid:
        os._exit(0 if forks.do(f"{tmp_path} two".encode(), environment()) else 1)
    assert forks.do(f"{tmp_path} three".encode(), environment())
    assert os.waitpid(pid, 0)[1] == 0
    parents = [about(tmp_path / name)[1] for name in ("one", "two", "three")]
    assert parents[0] == parents[2] != parents[1]


def test_where_no_process_can_be_started_the_error_is_told(
    forks: Forks, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "executable", str(tmp_path / "missing"))
    with pytest.raises(OSError, match="missing"):
        forks.do(f"{tmp_path} one".encode(), environment())
