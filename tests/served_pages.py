"""gsdmsr view as a process of its own, for tests, and what it answers."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def view(*words: object) -> Iterator[str]:
    """Run the command, yield the address that it says, and end it as Ctrl-C would."""
    line = [sys.executable, "-m", "gsdmsr_cli", "view", *map(str, words), "--json"]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())["address"]
        finally:
            process.send_signal(signal.SIGINT)
            assert process.wait(30) == 0


def get(address: str, name: str = "") -> bytes:
    with urllib.request.urlopen(address + name, timeout=30) as answer:
        found: bytes = answer.read()
        return found
