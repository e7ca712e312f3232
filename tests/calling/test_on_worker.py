"""What a worker does with Ctrl-C, as which a cancelled task sees it."""

from __future__ import annotations

import _thread
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from gsdmsr_cli import __version__
from gsdmsr_cli.calling import on_worker
from gsdmsr_cli.calling.calls import INTERRUPTED
from gsdmsr_cli.calling.on_worker import do

SLEEPS = "import time; time.sleep(20)"


@pytest.fixture
def ignored() -> Iterator[None]:
    """Ignore Ctrl-C, as what a script starts in the background does."""
    earlier = signal.signal(signal.SIGINT, signal.SIG_IGN)
    yield
    signal.signal(signal.SIGINT, earlier)


@pytest.mark.usefixtures("ignored")
def test_a_cancelled_task_is_ended_also_where_ctrl_c_is_ignored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "token").write_text("token")
    needs = {"version": __version__, "paths": [], "out": "", "token": str(tmp_path / "token")}

    def start(*_: Any, **__: Any) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-c", SLEEPS], stderr=subprocess.DEVNULL)

    monkeypatch.setattr(on_worker, "start_logged", start)
    timer = threading.Timer(1.0, _thread.interrupt_main)  # what Ray does
    timer.start()
    _, code, _ = do(["doctor"], str(tmp_path / "log"), 1, needs)
    timer.join()
    assert code == INTERRUPTED
    assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
