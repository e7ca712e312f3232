"""Folders: one writer at a time or several readers, whatever becomes of them."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.locks import in_turn, one_of_readers, sole_writer

needs_locks = pytest.mark.skipif(sys.platform == "win32", reason="folders cannot be locked there")

WRITER_WITH_A_CHILD = """
import os, sys, time
from pathlib import Path
from gsdmsr_cli.ground.locks import sole_writer

with sole_writer(Path(sys.argv[1])):
    if not os.fork():
        print(os.getpid(), flush=True)
    time.sleep(60)
"""


@needs_locks
def test_a_folder_has_one_writer_until_that_is_done(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with sole_writer(folder):
        with (
            pytest.raises(DataError, match="another process is writing there"),
            sole_writer(folder),
        ):
            pass
        with sole_writer(tmp_path / "other"):
            pass
        with pytest.raises(DataError), sole_writer(folder):
            pass  # what was refused has not let go of what is held
    with sole_writer(folder):
        assert not any(folder.iterdir())


@needs_locks
def test_a_killed_writer_lets_go_though_what_it_has_forked_lives_on(tmp_path: Path) -> None:
    command = [sys.executable, "-c", WRITER_WITH_A_CHILD, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as writer:
        assert writer.stdout is not None
        child = int(writer.stdout.readline())
        try:
            with pytest.raises(DataError), sole_writer(tmp_path):
                pass
            writer.kill()
            writer.wait()
            os.kill(child, 0)
            with sole_writer(tmp_path):
                pass
        finally:
            writer.kill()
            os.kill(child, signal.SIGKILL)


@needs_locks
def test_readers_share_a_folder_that_nobody_writes_to(tmp_path: Path) -> None:
    with (
        one_of_readers(tmp_path),
        one_of_readers(tmp_path),
        pytest.raises(DataError, match="another process is reading there; wait for its end or"),
        sole_writer(tmp_path),
    ):
        pass
    with (
        sole_writer(tmp_path),
        pytest.raises(DataError, match=r"another process is writing there; wait for its end$"),
        one_of_readers(tmp_path),
    ):
        pass
    with one_of_readers(tmp_path / "missing"):
        assert not (tmp_path / "missing").exists()


@needs_locks
def test_who_waits_has_its_turn_at_the_folder_that_is_there_then(tmp_path: Path) -> None:
    """What the one before has moved away, or removed, is not what the next one holds."""
    folder, order = tmp_path / "a", list[str]()

    def wait() -> None:
        with in_turn(folder):
            order.append("second")
            with pytest.raises(DataError), sole_writer(folder):
                pass

    thread = threading.Thread(target=wait)
    with in_turn(folder):
        thread.start()
        time.sleep(0.2)
        folder.rename(tmp_path / "b")
        order.append("first")
    thread.join(timeout=10)
    assert order == ["first", "second"] and folder.is_dir()
