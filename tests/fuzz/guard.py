"""What holds of whatever is read: the project's own error in one line, soon, and no traces."""

from __future__ import annotations

import os
import sys
import sysconfig
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gsdmsr_cli
from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.ground.printing import is_printable

SECONDS = 2.0
"""Processor time that one input may take."""

LONGEST = 4000
"""Characters of a message."""

_ACTS = (
    "os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.symlink", "os.link", "os.truncate",
    "os.chmod", "os.chown", "os.utime", "os.system", "os.exec", "os.posix_spawn", "os.spawn",
    "os.fork", "os.forkpty", "os.putenv", "os.unsetenv", "subprocess.Popen", "socket.connect",
    "socket.bind", "socket.getaddrinfo", "socket.sendto", "urllib.Request", "shutil.rmtree",
    "shutil.move", "shutil.copyfile", "pickle.find_class", "exec",
)  # fmt: skip
"""Events of Python that a reader has no business to cause."""

_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND

_MODULES = tuple(
    str(Path(place).resolve())
    for place in {*sysconfig.get_paths().values(), Path(gsdmsr_cli.__file__).parents[1]}
)
"""Where Python reads its modules, which some functions load when they are first called."""


class ViolationError(AssertionError):
    """An input has done what none may."""


class _Watch:
    """What the hook looks at: where files may be opened, and what has been done besides."""

    def __init__(self) -> None:
        self.folder: str | None = None
        self.seen: list[str] = []
        self.installed = False

    def hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        if self.folder is None:
            return
        if event == "open":
            self._opened(*arguments)
        elif event in _ACTS and not (event == "exec" and _of_a_module(arguments[0])):
            self.seen.append(f"{event}{arguments!r:.200}")

    def _opened(self, path: Any, mode: Any, flags: Any) -> None:
        if isinstance(path, int):
            return
        name = os.path.realpath(os.fsdecode(path))
        if flags & _WRITING:
            self.seen.append(f"{name!r} was opened for writing")
        elif not name.startswith((f"{self.folder}/", "/proc/", *_MODULES)):
            self.seen.append(f"{name!r} was opened")


_watch = _Watch()


def _of_a_module(code: Any) -> bool:
    """Return whether code that is run is that of a module, or what dataclasses make."""
    name = getattr(code, "co_filename", "")
    return name.startswith((*_MODULES, "<frozen", "<string>", "<__array_function__"))


@contextmanager
def watched(folder: Path) -> Iterator[None]:
    """Raise ViolationError if the block opens a file outside of ``folder`` or changes anything."""
    if not _watch.installed:
        sys.addaudithook(_watch.hook)
        _watch.installed = True
    _watch.seen.clear()
    _watch.folder = str(folder.resolve())
    try:
        yield
    finally:
        _watch.folder = None
    if _watch.seen:
        raise ViolationError("; ".join(_watch.seen[:3]))


def hold(read: Callable[[], object], folder: Path) -> None:
    """Raise ViolationError unless ``read`` behaves as every reader of files from elsewhere must.

    Any other exception than GsdmsrError passes through, and is a violation as well.
    """
    started = time.process_time()
    with watched(folder):
        try:
            read()
        except GsdmsrError as error:
            _check_message(error)
    spent = time.process_time() - started
    if spent > SECONDS:
        raise ViolationError(f"took {spent:.1f} s")


def _check_message(error: GsdmsrError) -> None:
    text = str(error)
    if not (text and is_printable(text) and len(text) <= LONGEST):
        raise ViolationError(f"its message is not a printable line: {text!r:.300}")
    if error.exit_code not in (2, 3, 4):
        raise ViolationError(f"ends with exit code {error.exit_code}: {text!r:.300}")
