"""gsdmsr train in a process of its own: what ends it, what does not, and what is left then."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from sinks import SINKS, sink
from training_checks import OPTIONS, STEPS

from gsdmsr_cli.runs.run import open_run

LINE = ["--preset=dnerf", "--set=motion={name: static}", *(f"--set={text}" for text in OPTIONS)]


def command(data: Path, run: Path, *options: str) -> list[str]:
    call = [sys.executable, "-m", "gsdmsr_cli", "train", "--data", str(data), "--out", str(run)]
    return [*call, *options]


def train(
    data: Path, run: Path, *options: str, err: int = subprocess.PIPE
) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(command(data, run, *options), stderr=err, timeout=600, check=False)


@pytest.mark.parametrize("lost", SINKS)
def test_a_log_that_nobody_gets_does_not_end_a_training(
    tiny_scene: Path, tmp_path: Path, lost: str
) -> None:
    with sink(lost) as err:
        ended = train(tiny_scene, tmp_path / "run", *LINE, err=err)
    assert ended.returncode == 0
    run = open_run(tmp_path / "run")
    assert run.load().step == STEPS == run.read_log()[-1]["step"]
    assert run.training_path.is_file()


def wait_until(holds: Callable[[], object], seconds: float = 300.0) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGHUP")
def test_a_connection_that_is_dropped_ends_a_training_in_order(
    tiny_scene: Path, tmp_path: Path
) -> None:
    """As a shell does it: SIGHUP to all processes, and nobody reads what they write."""
    run, log = tmp_path / "run", tmp_path / "run" / "metrics.jsonl"
    call = command(tiny_scene, run, *LINE, "--steps=1000000")
    with (
        sink(SINKS[0]) as err,
        subprocess.Popen(
            call,
            stderr=err,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),  # as without nohup
        ) as training,
    ):
        wait_until(lambda: log.exists() and log.stat().st_size)
        os.killpg(training.pid, signal.SIGHUP)
        assert training.wait(timeout=60) == 130
    opened = open_run(run)
    assert opened.load().step == opened.read_log()[-1]["step"] > 0
    assert opened.training_path.is_file()


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no list of processes here")
@pytest.mark.parametrize("end", [signal.SIGTERM, signal.SIGKILL], ids=["SIGTERM", "SIGKILL"])
def test_what_compiles_for_the_first_time_ends_soon_and_whole(
    tiny_scene: Path, tmp_path: Path, end: signal.Signals
) -> None:
    cold = tmp_path / "cold"
    environment = os.environ | {"NUMBA_CACHE_DIR": str(cold)}
    call = command(tiny_scene, tmp_path / "run", *LINE)
    with subprocess.Popen(
        call, env=environment, stderr=subprocess.PIPE, start_new_session=True
    ) as training:
        assert training.stderr is not None
        wait_until(lambda: list(cold.rglob("*.lock")))
        began = time.monotonic()
        training.send_signal(end)
        training.stderr.read()
        assert training.wait() == (130 if end == signal.SIGTERM else -end)
        # 2 s where nothing else runs; 5 s are promised
        assert time.monotonic() - began < 15
        wait_until(lambda: not of_session(training.pid), seconds=10)


def of_session(session: int) -> list[int]:
    """Return the processes of a session that have not ended."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            state, _, _, own = path.read_text().rpartition(")")[2].split()[:4]
            found += [int(path.parent.name)] if int(own) == session and state != "Z" else []
    return found
