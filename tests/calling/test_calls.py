"""Commands in processes of their own: they fail aloud, and those side by side go on apart."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from gsdmsr_cli.calling import calls
from gsdmsr_cli.calling.calls import Line, call, call_side_by_side
from gsdmsr_cli.ground.errors import GsdmsrError


def text(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def test_a_command_that_fails_says_so(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(GsdmsrError, match=r"gsdmsr eval has failed with exit code 3.* above"):
        call("eval", str(tmp_path / "nothing"))
    assert "not a run folder" in capfd.readouterr().err


def test_commands_of_a_work_follow_each_other(tmp_path: Path) -> None:
    logs = [tmp_path / "new" / "a", tmp_path / "b"]
    order: list[str] = []

    def work(log: Path) -> Iterator[Line]:
        for line in (["--version"], ["doctor", "--json"]):
            order.append(f"{log.name} {line[0]}")
            yield line
            shown = text(log)
            assert "gsdmsr" in shown and ("cores" in shown) == (line[0] == "doctor")

    call_side_by_side({log: work(log) for log in logs}, threads=1)
    assert order[:2] == ["a --version", "b --version"]
    assert sorted(order[2:]) == ["a doctor", "b doctor"]


def test_one_that_fails_ends_its_own_work_alone(tmp_path: Path) -> None:
    works: dict[Path, Iterator[Line]] = {
        tmp_path / "bad": iter([["eval", str(tmp_path / "nothing")], ["doctor"]]),
        tmp_path / "good": iter([["--version"], ["doctor"]]),
    }
    with pytest.raises(GsdmsrError, match=r"eval has failed with exit code 3.*in .*bad"):
        call_side_by_side(works, threads=1)
    assert "not a run folder" in text(tmp_path / "bad")
    assert "numba" in text(tmp_path / "good") and "numba" not in text(tmp_path / "bad")


def test_an_error_between_commands_leaves_none_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    true, started = calls.start, []

    def remember(*given: Any) -> subprocess.Popen[bytes]:
        started.append(true(*given))
        return started[-1]

    monkeypatch.setattr(calls, "start", remember)

    def broken() -> Iterator[Line]:
        yield ["--version"]
        raise ValueError("between")

    handler = signal.getsignal(signal.SIGINT)
    works = {tmp_path / "broken": broken(), tmp_path / "other": iter([["doctor"]])}
    with pytest.raises(ValueError, match="between"):
        call_side_by_side(works, threads=1)
    assert signal.getsignal(signal.SIGINT) is handler
    assert started and all(process.returncode is not None for process in started)


def test_ctrl_c_lets_no_further_command_begin(tmp_path: Path) -> None:
    def work() -> Iterator[Line]:
        yield ["--version"]
        os.kill(os.getpid(), signal.SIGINT)
        yield ["--version"]
        pytest.fail("went on")

    with pytest.raises(KeyboardInterrupt):
        call_side_by_side({tmp_path / "log": work()}, threads=1)
