"""What a worker of Ray does: it looks whether it has all that it needs, and runs a command."""

from __future__ import annotations

import platform
import signal
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gsdmsr_cli import __version__
from gsdmsr_cli.calling.calls import INTERRUPTED, Line, start_logged
from gsdmsr_cli.ground.errors import DataError

_POLL_S = 0.1


def do(line: Line, log: str, threads: int, needs: Mapping[str, Any]) -> tuple[str, int, str]:
    """Run a command to its end; Ctrl-C, as which a cancelled task sees it, is handed on.

    A cluster that was started in the background of a script ignores Ctrl-C, and so do its workers
    unless they are told otherwise: Python drops the interrupt without a word.

    Args:
        line: the command line, empty to look only.
        log: file that all it shows is added to.
        threads: that it may use.
        needs: see ``lack``.

    Returns:
        The name of this machine, the command's exit code, and what this machine lacks or "".
    """
    host, missing = platform.node(), lack(needs)
    if missing:
        return host, DataError.exit_code, missing
    if not line:
        return host, 0, ""
    earlier = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        process = start_logged(line, Path(log), threads, ends_with_us=True)
        return host, _result(process), ""
    finally:
        signal.signal(signal.SIGINT, earlier)


def _result(process: subprocess.Popen[bytes]) -> int:
    """Return the exit code of a command that has ended, handing the first Ctrl-C on until then."""
    interrupted = False
    while True:
        try:
            while process.poll() is None:
                time.sleep(_POLL_S)  # Ray's interrupt comes between two calls, and ends none
            break
        except KeyboardInterrupt:
            if not interrupted:  # a second one would keep it from saving what it has
                process.send_signal(signal.SIGINT)
            interrupted = True
    return INTERRUPTED if interrupted else process.returncode


def lack(needs: Mapping[str, Any]) -> str:
    """Return what this machine lacks, or "" if nothing.

    Args:
        needs: "version" of gsdmsr, "paths" that must be there, the folder "out", and a "token", a
            file in it that holds its own name.
    """
    if needs["version"] != __version__:
        return f"has gsdmsr {__version__}, not {needs['version']}; install the same everywhere"
    for path in needs["paths"]:
        if not Path(path).exists():
            return f"does not see {path}; data must lie where every worker finds it by this name"
    token = Path(needs["token"])
    if not token.is_file() or token.read_text(encoding="utf-8") != token.name:
        return f"does not share the storage of {needs['out']}; give an --out that all machines see"
    return ""
