"""Runs the command line and turns errors and signals into one line and an exit code."""

from __future__ import annotations

import errno
import itertools
import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Annotated, cast

import typer

from gsdmsr_cli.cli import (
    benchmark,
    cache,
    compare,
    demo,
    doctor,
    export,
    info,
    make,
    prepare,
    presets,
    render,
    train,
    view,
    weights,
)
from gsdmsr_cli.cli import eval as evaluate
from gsdmsr_cli.cli._common import JSON, give_common_options
from gsdmsr_cli.ground import origin, say
from gsdmsr_cli.ground.errors import DataError, GsdmsrError, UsageError
from gsdmsr_cli.ground.printing import is_printable, one_line
from gsdmsr_cli.ground.streams import unfailing

# These files import gsdmsr_cli.commands in the functions that run them: torch alone would make
# --help slow.
_COMMANDS = (
    make, prepare, train, view, evaluate, compare, render, export, info, demo, presets, doctor,
    weights, cache, benchmark,
)  # fmt: skip
"""In the order of --help."""

app = typer.Typer(
    help="Dynamic 3D Gaussian splatting: train, render, measure and export.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
for _command in _COMMANDS:
    _command.register(app)
give_common_options(app)

# What the machine, not the program, is to blame for when a file cannot be read or written.
_MACHINE_ERRNOS = frozenset(
    {
        errno.ENOSPC,
        errno.EDQUOT,
        errno.EFBIG,
        errno.EROFS,
        errno.EACCES,
        errno.EPERM,
        errno.EIO,
        errno.EMFILE,
        errno.ENAMETOOLONG,
        errno.ENOTDIR,
        errno.EISDIR,
    }
)


def _version(value: bool) -> None:
    if value:
        typer.echo(f"gsdmsr {origin.version()}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


_INTERRUPTED = 130
_AGAIN_S = 0.001
"""After which a Ctrl-C comes again that came where no exception may be raised."""

_NO_RAISING = "_numba_unpickle"
"""Called by numba's C code as a kernel returns a tuple, which does not look for exceptions: a
KeyboardInterrupt there becomes a SystemError, or a crash."""

_KINDS = {1: "internal", 2: "usage", 3: "data", 4: "threshold", _INTERRUPTED: "interrupted"}
"""What the errors of each exit code are called in JSON."""

# The command-line errors of typer share this base, which typer does not export by name.
_CommandLineError = cast(type[typer.BadParameter], typer.BadParameter.__base__)


def main() -> None:
    """Run the command line and exit: 0 ok, 1 internal, 2 usage, 3 data, 4 threshold, 130 Ctrl-C."""
    sys.exit(_run())


def _run() -> int:
    own = itertools.takewhile(lambda word: word != "--", sys.argv[1:])
    with unfailing() as lost, say.on_its_own(as_json=JSON in own):
        code, reason = _call(), lost()
        if reason is not None and code == 0:
            code = DataError.exit_code
            message = f"standard output cannot be written: {reason}; what was asked for is lost"
            _tell(message, code)
    return code


def _call() -> int:
    try:
        _require_printable(sys.argv[1:])
        with ctrl_c_that_spares_imports():
            result = typer.main.get_command(app).main(prog_name="gsdmsr", standalone_mode=False)
    except (KeyboardInterrupt, typer.Abort):
        result = _INTERRUPTED
    except Exception as error:
        if os.environ.get("GSDMSR_DEBUG"):
            traceback.print_exc()
        message, code = _explain(error)
        _tell(message, code)
        return code
    if result == _INTERRUPTED:  # typer makes an exit of Ctrl-C, or an Abort
        say.answer_with_error(_KINDS[result], "interrupted", result)
    return result if isinstance(result, int) else 0


def _tell(message: str, code: int) -> None:
    line = one_line(message)
    say.error(line)
    say.answer_with_error(_KINDS.get(code, _KINDS[1]), line, code)


def _require_printable(arguments: list[str]) -> None:
    """Raise UsageError if an argument would steer a terminal or is not text: names are printed."""
    for argument in arguments:
        if not is_printable(argument.translate({9: " ", 10: " ", 13: " "})):
            _require_names_in_utf8(argument)
            raise UsageError(
                f"{argument}: this argument has control characters or is not UTF-8; rename the "
                "file or give another path to it"
            )


def _require_names_in_utf8(argument: str) -> None:
    """Raise UsageError if the argument is UTF-8 and Python has been told that names are not."""
    encoding = sys.getfilesystemencoding()
    if encoding != "utf-8" and is_printable(os.fsencode(argument).decode(errors="surrogateescape")):
        raise UsageError(f"{argument}: Python takes names for {encoding} here; set PYTHONUTF8=1")


@contextmanager
def ctrl_c_that_spares_imports() -> Iterator[None]:
    """Let Ctrl-C raise KeyboardInterrupt, but not in an import: the core of torch would abort.

    SIGTERM, by which containers and schedulers end a process, and SIGHUP, which comes when a
    connection or a terminal is closed, do what Ctrl-C does at the time. A SIGHUP that is ignored,
    as under nohup, stays ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield  # where Python allows no handlers
        return
    handlers = {signal.SIGINT: _interrupt, signal.SIGTERM: _terminate}
    if sys.platform != "win32" and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        handlers[signal.SIGHUP] = _terminate
    before = {number: signal.signal(number, handler) for number, handler in handlers.items()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _terminate(_number: int, _frame: FrameType | None) -> None:
    signal.raise_signal(signal.SIGINT)


def _interrupt(_number: int, frame: FrameType | None) -> None:
    while frame is not None:
        if frame.f_globals.get("__name__") == "importlib._bootstrap":
            os._exit(130)  # nothing has been begun that would have to be cleared away
        if frame.f_code.co_name == _NO_RAISING:
            again = threading.Timer(_AGAIN_S, signal.raise_signal, [signal.SIGINT])
            again.daemon = True
            again.start()
            return
        frame = frame.f_back
    raise KeyboardInterrupt


def _explain(error: Exception) -> tuple[str, int]:
    """Return the one-line message and the exit code of an error."""
    if isinstance(error, GsdmsrError):
        return str(error), error.exit_code
    if isinstance(error, _CommandLineError):
        message = error.format_message().replace("Value error, ", "")
        return message or "missing command; see --help", UsageError.exit_code
    if isinstance(error, OSError) and error.errno in _MACHINE_ERRNOS:
        where = f"{error.filename}: " if error.filename else ""
        return f"{where}{error.strerror}; free space or choose another place", 3
    if type(error).__name__ == "OutOfMemoryError":  # torch's, which is not imported here
        return (
            "the GPU's memory is full; lower --set training.views_per_step=..., --set "
            "data.cache_mib=... or --set density.cap=..., raise --downscale, or use --device cpu"
        ), 3
    hint = "set GSDMSR_DEBUG=1 for the traceback"
    return f"internal: {type(error).__name__}: {error} ({hint})", 1
