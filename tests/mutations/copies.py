"""A copy of the repository in which one wrong change after another is tried."""

from __future__ import annotations

import contextlib
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from changes import ROOT, Change, is_kernel

MEMORY = 8 << 30
"""Most memory that a run of tests may have [bytes]: a wrong change may ask for any amount."""

COMPILED = "gsdmsr_cli/backends/cpu/__pycache__"
"""Where compiled kernels lie, in a folder for each state of their sources."""

OPTIONS = "-x", "-q", "-n", "0", "-p", "no:cacheprovider", "--no-header", "--tb=no", "-rfE"
"""Of pytest: in one process, up to the first test that fails."""

_FAILED = re.compile(r"^(?:FAILED|ERROR) (\S+)", re.MULTILINE)


@dataclass(frozen=True)
class Outcome:
    """What tests said: "noticed", "not noticed", "out of time", or "no tests"; by which, in s."""

    verdict: str
    by: str
    seconds: float


class Copy:
    """A copy of all files that git knows or would know, in a folder of its own."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._renew()

    def _renew(self) -> None:
        """Copy what has changed; what has not keeps its date, by which caches go."""
        asked = "git", "ls-files", "-co", "--exclude-standard", "-z"
        listing = subprocess.run(asked, cwd=ROOT, check=True, capture_output=True, text=True)
        names = {name for name in listing.stdout.split("\0") if name and (ROOT / name).is_file()}
        for name in names:
            mine, theirs = self.folder / name, ROOT / name
            if not mine.is_file() or mine.read_bytes() != theirs.read_bytes():
                mine.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(theirs, mine)
        for part in ("gsdmsr_cli", "tests"):
            for path in (self.folder / part).rglob("*.*"):
                name = path.relative_to(self.folder).as_posix()
                if path.is_file() and "__pycache__" not in name and name not in names:
                    path.unlink()

    def test(self, tests: Sequence[str], limit: float) -> Outcome:
        """Run those tests that there are, up to the first that fails."""
        there = [t for t in tests if (self.folder / t.partition("::")[0]).exists()]
        if not there:
            return Outcome("no tests", "", 0.0)
        scratch = self.folder / "scratch"
        scratch.mkdir(exist_ok=True)
        started = time.perf_counter()
        process = subprocess.Popen(
            [sys.executable, "-m", "pytest", *OPTIONS, *there],
            cwd=self.folder,
            env=os.environ | {"PYTHONPATH": str(self.folder), "TMPDIR": str(scratch)},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
            preexec_fn=_limit_memory,
        )
        try:
            output, _ = process.communicate(timeout=limit)
            verdict = "not noticed" if process.returncode in (0, 5) else "noticed"
        except subprocess.TimeoutExpired:
            output, verdict = "", "out of time"
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)  # and whatever it has started
            process.wait()
            shutil.rmtree(scratch, ignore_errors=True)
        by = _FAILED.search(output)
        return Outcome(verdict, by[1] if by else "", round(time.perf_counter() - started, 1))

    @contextmanager
    def changed(self, change: Change) -> Iterator[None]:
        """Have the change in the copy within the block; kernels compiled of it go with it.

        Raises:
            ValueError: the place of the change is not there.
        """
        path = self.folder / change.file
        before, date = path.read_text(encoding="utf-8"), path.stat().st_mtime_ns
        compiled = self.folder / COMPILED
        kernels = set(compiled.glob("*"))
        path.write_text(change.applied(before), encoding="utf-8")
        try:
            yield
        finally:
            path.write_text(before, encoding="utf-8")
            os.utime(path, ns=(date, date))
            if is_kernel(change.file):
                for folder in set(compiled.glob("*")) - kernels:
                    shutil.rmtree(folder, ignore_errors=True)


def _limit_memory() -> None:
    resource.setrlimit(resource.RLIMIT_DATA, (MEMORY, MEMORY))
