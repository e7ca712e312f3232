"""Files and folders: one writer at a time, whatever becomes of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import sole_writer

needs_locks = pytest.mark.skipif(sys.platform == "win32", reason="folders cannot be locked there")

WRITER_WITH_A_CHILD = """
import os, sys, time
from pathlib import Path
from gsdmsr_cli.ground.files import sole_writer

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
