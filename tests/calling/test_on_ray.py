"""Commands as tasks of a real Ray cluster on this machine: each is retried alone, and named."""

from __future__ import annotations

import os
import platform
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gsdmsr_cli import __version__
from gsdmsr_cli.calling.calls import Line
from gsdmsr_cli.calling.on_ray import Needs, connected, needs_of, require_workers
from gsdmsr_cli.calling.on_worker import lack
from gsdmsr_cli.calling.ray_calls import call_on_ray
from gsdmsr_cli.ground.errors import DataError, GsdmsrError, UsageError
from gsdmsr_cli.runs.run import open_run


@pytest.fixture(scope="module")
def ray() -> Iterator[Any]:
    pytest.importorskip("ray", reason="pip install 'gsdmsr[ray]'")
    if not sys.platform.startswith("linux"):
        pytest.skip("workers are looked for in /proc")
    with connected("2") as found:
        yield found


@pytest.fixture
def needs(tmp_path: Path) -> Iterator[Needs]:
    with needs_of(tmp_path, []) as found:
        yield found


def text(path: Path) -> str:
    return path.read_text(encoding="utf-8") if path.is_file() else ""


def wait_until(holds: Callable[[], object], seconds: float = 200.0) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.05)


def running(word: str) -> dict[int, int]:
    """Return the parents of the processes whose command line has this word, by their ids."""
    found = {}
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            if word in (folder / "cmdline").read_text().split("\0"):
                stat = (folder / "stat").read_text().rpartition(")")[2].split()
                found |= {int(folder.name): int(stat[1])} if stat[0] != "Z" else {}
    return found


def endless(data: Path, run: Path) -> Line:
    length = "--preset", "static", "--steps", "10000000", "--threads", "1"
    return ["train", "--data", str(data), "--out", str(run), *length]


def test_commands_of_a_work_follow_each_other(ray: Any, needs: Needs, tmp_path: Path) -> None:
    ended: list[Path] = []
    works = {tmp_path / n: lambda: iter([["--version"], ["doctor", "--json"]]) for n in "ab"}
    require_workers(ray, needs)
    call_on_ray(ray, works, 1, needs, ended.append)
    assert sorted(ended) == sorted(works)
    assert all("gsdmsr" in text(log) and "cores" in text(log) for log in works)


def test_one_that_fails_ends_its_own_work_alone(ray: Any, needs: Needs, tmp_path: Path) -> None:
    ended: list[Path] = []
    bad, good = tmp_path / "bad", tmp_path / "good"
    works: dict[Path, Callable[[], Iterator[Line]]] = {
        bad: lambda: iter([["eval", str(tmp_path / "nothing")], ["doctor"]]),
        good: lambda: iter([["--version"]]),
    }
    with pytest.raises(GsdmsrError, match=r"eval has failed with exit code 3.*in .*bad"):
        call_on_ray(ray, works, 1, needs, ended.append)
    assert ended == [good] and "not a run folder" in text(bad)


def test_a_worker_that_is_killed_takes_its_command_along_which_begins_again_alone(
    ray: Any, needs: Needs, tiny_scene: Path, tmp_path: Path
) -> None:
    run, log, other = tmp_path / "run", tmp_path / "log", tmp_path / "other"
    begun: list[str] = []

    def work() -> Iterator[Line]:
        begun.append("killed" if begun else "first")
        yield endless(tiny_scene, run) if len(begun) == 1 else ["--version"]

    def calm() -> Iterator[Line]:
        begun.append("other")
        yield ["doctor"]

    killed: list[int] = []

    def kill() -> None:
        wait_until(lambda: "ms/step" in text(log))
        killed.extend(running(str(run)))
        for worker in running(str(run)).values():
            os.kill(worker, signal.SIGKILL)

    thread = threading.Thread(target=kill)
    thread.start()
    ended: list[Path] = []
    call_on_ray(ray, {log: work, other: calm}, 1, needs, ended.append)
    thread.join()
    assert sorted(begun) == ["first", "killed", "other"] and set(ended) == {log, other}
    assert killed and not running(str(run))
    assert text(log).endswith(")\n") and "gsdmsr" in text(log)  # the version


def test_ctrl_c_saves_the_trainings_that_are_under_way(
    ray: Any, needs: Needs, tiny_scene: Path, tmp_path: Path
) -> None:
    run, log = tmp_path / "run", tmp_path / "log"

    def press() -> None:
        wait_until(lambda: "ms/step" in text(log))
        os.kill(os.getpid(), signal.SIGINT)

    handler = signal.getsignal(signal.SIGINT)
    thread = threading.Thread(target=press)
    thread.start()
    with pytest.raises(KeyboardInterrupt):
        call_on_ray(ray, {log: lambda: iter([endless(tiny_scene, run)])}, 1, needs, print)
    thread.join()
    assert "interrupted at step" in text(log) and open_run(run).load().step > 0
    assert signal.getsignal(signal.SIGINT) is handler


def test_a_worker_that_lacks_something_is_named(ray: Any, needs: Needs, tmp_path: Path) -> None:
    missing = needs | {"paths": [str(tmp_path / "data")]}
    with pytest.raises(DataError, match=f"worker {platform.node()}: does not see .*data"):
        require_workers(ray, missing)
    with pytest.raises(GsdmsrError, match=f"worker {platform.node()}: does not see .*data"):
        call_on_ray(ray, {tmp_path / "log": lambda: iter([["--version"]])}, 1, missing, print)
    assert not (tmp_path / "log").exists()


def test_what_a_worker_lacks(needs: Needs, tmp_path: Path) -> None:
    assert lack(needs) == ""
    assert f"has gsdmsr {__version__}, not 9.9" in lack(needs | {"version": "9.9"})
    assert "does not see" in lack(needs | {"paths": [str(tmp_path / "no")]})
    token = Path(needs["token"])
    token.write_text("of another folder of this name")
    assert "does not share the storage of" in lack(needs)
    token.unlink()
    assert "does not share the storage of" in lack(needs)


@pytest.mark.parametrize("workers", ["0", "-1", "ray://host", "host:1", "ray://a b:1", "", "all"])
def test_what_is_no_cluster_is_refused(workers: str) -> None:
    with pytest.raises(UsageError, match="allowed are ray://HOST:PORT, auto, or a number"):
        connected(workers).__enter__()


def test_without_ray_it_is_told_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UsageError, match=r"--workers needs ray.*pip install 'gsdmsr\[ray\]'"):
        connected("auto").__enter__()


class RayError(Exception):
    """As Ray has it: of no class of Python's."""


def ray_whose_init(init: Callable[..., None]) -> SimpleNamespace:
    exceptions = SimpleNamespace(RayError=RayError)
    return SimpleNamespace(init=init, exceptions=exceptions, shutdown=lambda: None)


@pytest.mark.parametrize("failures", [2, 3])
def test_a_head_node_that_begins_too_slowly_is_asked_again(
    monkeypatch: pytest.MonkeyPatch, failures: int
) -> None:
    asked: list[int] = []

    def init(**_: Any) -> None:
        asked.append(len(asked))
        if len(asked) <= failures:
            # as ray.util.client.worker has it, with what the server has printed
            raise ConnectionAbortedError("Initialization failure from server:\nTraceback\nslow")

    monkeypatch.setitem(sys.modules, "ray", ray_whose_init(init))
    if failures == 3:
        with pytest.raises(DataError, match=r"no connection in 3 attempts \(slow\); see whether"):
            connected("ray://head:10001").__enter__()
    else:
        with connected("ray://head:10001"):
            assert len(asked) == 3


def test_a_cluster_that_asks_for_a_token_is_no_internal_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def init(**_: Any) -> None:
        raise RayError("InvalidAuthToken")

    monkeypatch.setitem(sys.modules, "ray", ray_whose_init(init))
    with pytest.raises(DataError, match=r"InvalidAuthToken.*~/\.ray/auth_token.*RAY_AUTH_MODE"):
        connected("auto").__enter__()
