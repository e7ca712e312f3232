"""Runs jobs of COLMAP in a child process, which is killed if this process ends."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Mapping
from typing import Any

from gsdmsr_cli.ground.errors import DataError, GsdmsrError
from gsdmsr_cli.ground.progress import OnProgress

REFUSED = 3
"""Exit code of a child whose last line says why the data cannot be used."""

DISK = ("disk", "no space", "file too large", "filesystem error", "i/o error")
"""Words by which messages of SQLite and COLMAP say that a file could not be written."""

FAILED = "COLMAP has failed in its job"
"""How the message of a job's failure begins."""

ONE_THREAD = {"OMP_NUM_THREADS": "1"}
"""OpenMP's threads come and go with the load, and what is found would change with them."""


def run_child(job: str, arguments: Mapping[str, Any], on_progress: OnProgress) -> None:
    """Do a job of ``capture.colmap`` and wait for it; it has ended when this returns or raises.

    Args:
        job: name of the job.
        arguments: what it takes, fit for JSON; ``out`` is the folder that it writes.
        on_progress: called with how much is done, and of how much.

    Raises:
        DataError: the job says that the data cannot be used.
        GsdmsrError: the job has failed.
    """
    # the folder is named for lists of processes; arguments may be longer than a command line
    line = [sys.executable, "-m", "gsdmsr_cli.capture.colmap", job, str(arguments["out"])]
    last = ""
    # in a session of its own: Ctrl-C reaches this process alone, which then kills the child
    with (
        tempfile.TemporaryFile("w+", errors="replace") as errors,
        subprocess.Popen(
            line,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            start_new_session=True,
            env=os.environ | ONE_THREAD,
        ) as process,
    ):
        try:
            assert process.stdin is not None and process.stdout is not None
            process.stdin.write(json.dumps(arguments) + "\n")
            process.stdin.flush()
            for text in process.stdout:
                match text.split():
                    case ["progress", done, total]:
                        on_progress(int(done), int(total))
                    case _:
                        last = text.strip()
            code = process.wait()
        except BaseException:
            process.kill()
            raise
        if code == REFUSED:
            raise DataError(last)
        if code:
            errors.seek(0)
            raise _failure(job, [line.strip() for line in errors if line.strip()], code)


def _failure(job: str, lines: list[str], code: int) -> GsdmsrError:
    """Return the error of a job that has failed, from what it has printed."""
    for line in lines:  # COLMAP may go on to print where in its code that was
        if any(word in line.lower() for word in DISK):
            return DataError(
                f"COLMAP cannot write its files ({line}); free space or choose another --out; what "
                "is finished is kept"
            )
    reason = lines[-1] if lines else f"exit code {code}"
    if reason.startswith(FAILED):  # in a child of that child
        return GsdmsrError(reason)
    return GsdmsrError(f"{FAILED} {job}: {reason}")


def receive_arguments() -> dict[str, Any]:
    """In a child: return what the job takes.

    A thread then waits for the end of stdin, that is, of the parent, and ends the child with it.
    """
    arguments: dict[str, Any] = json.loads(sys.stdin.readline())

    def wait() -> None:
        sys.stdin.read()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
    return arguments
