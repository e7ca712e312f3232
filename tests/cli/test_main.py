"""The command line as a whole: help, version, and how every error and signal ends."""

from __future__ import annotations

import errno
import json
import os
import signal
import subprocess
import sys
import time
from types import FrameType
from typing import Any

import numpy as np
import pytest
import torch
import typer

from gsdmsr_cli.cli.main import ctrl_c_that_spares_imports
from gsdmsr_cli.ground.errors import DataError, GsdmsrError, ThresholdError, UsageError
from gsdmsr_cli.ground.origin import version
from gsdmsr_cli.ground.printing import is_printable, one_line
from gsdmsr_cli.ops.rasterize.cpu.binning import bin_splats

Gsdmsr = Any  # the fixture of conftest.py


def python(*arguments: str, env: dict[str, str] | None = None) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *arguments]
    return subprocess.run(command, capture_output=True, text=True, timeout=60, env=env)


def test_the_package_runs_as_a_module() -> None:
    done = python("-m", "gsdmsr_cli", "--version")
    assert (done.returncode, done.stdout, done.stderr) == (0, f"gsdmsr {version()}\n", "")
    assert python("-m", "gsdmsr_cli", "trian").returncode == 2


def test_help_is_fast_and_lists_every_command() -> None:
    python("-m", "gsdmsr_cli", "--help")  # the first run may compile
    start = time.perf_counter()
    done = python("-m", "gsdmsr_cli", "--help")
    # about 0.25 s on an idle machine; the bound allows for a busy one
    assert time.perf_counter() - start < 2.0
    assert done.returncode == 0
    for name in ("train", "eval", "render", "export", "demo", "doctor", "benchmark"):
        assert name in done.stdout


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        ("gsdmsr tr", {"train"}),
        ("gsdmsr train --preset gs", {"gsdmsr", "gsdmsr-literal"}),
        ("gsdmsr presets n", {"n3v", "nerfies"}),
        ("gsdmsr export run --format ply-", {"ply-sequence"}),
        ("gsdmsr benchmark scenes s --preset hex", {"hexplane"}),
        ("gsdmsr train --dr", {"--dry-run"}),
    ],
)
def test_a_shell_completes_commands_presets_and_formats(words: str, expected: set[str]) -> None:
    asked = {"_GSDMSR_COMPLETE": "complete_bash", "COMP_WORDS": words}
    asked["COMP_CWORD"] = str(len(words.split()) - 1)
    done = subprocess.run(
        [sys.executable, "-m", "gsdmsr_cli"],
        capture_output=True, text=True, timeout=60, check=False, env=os.environ | asked,
    )  # fmt: skip
    assert set(done.stdout.split()) == expected, done.stderr


def test_the_script_for_completion_is_shown() -> None:
    # the shell is named, or typer would look for one among the parents of this process
    named = os.environ | {"_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"}
    done = python("-m", "gsdmsr_cli", "--show-completion", "bash", env=named)
    assert done.returncode == 0 and "_GSDMSR_COMPLETE=complete_bash" in done.stdout


def test_the_command_line_imports_nothing_heavy() -> None:
    heavy = ("torch", "numpy", "numba", "cv2", "yaml")
    done = python(
        "-c", f"import gsdmsr_cli.cli.main, sys; print([m for m in {heavy} if m in sys.modules])"
    )
    assert done.stdout.strip() == "[]"


def test_version(gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]) -> None:
    assert gsdmsr("--version") == 0
    assert capsys.readouterr().out == f"gsdmsr {version()}\n"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("--foo", "--foo"),
        ("trian", "trian"),
        ("train --out r", "--data"),
        ("train --data d --out r --step 3", "--steps"),
        ("train --data d --out r --steps x", "--steps"),
        ("train --data d --out r --device tpu", "--device"),
        ("train --data d --out r --steps 3 --budget 8m", "--budget and --steps"),
        ("train --data d --out r --resume --overwrite", "--resume and --overwrite"),
        ("eval", "RUN"),
        ("eval r --split train", "--split"),
        ("eval r --downscale 0", "--downscale"),
        ("render r --frames 0", "--frames"),
        ("render r --output rgb,dept", "--output: unknown 'dept'; did you mean 'depth'?"),
        ("render r --output ,", "--output: unknown ''"),
        ("render r --video mp3", "--video: unknown 'mp3'; did you mean 'mp4'?"),
        ("render r --size 400", "--size is '400'; allowed: WxH"),
        ("render r --size 0x4", "--size is '0x4'; allowed: WxH"),
        ("render r --size 99999x4", "both 1 to 16384 px"),
        ("render r --size 4x4 --scale 2", "--size and --scale"),
        ("render r --scale 0", "--scale is 0; allowed: more than 0"),
        ("render r --scale nan", "--scale is nan; allowed"),
        ("render r --fps 0", "--fps is 0; allowed"),
        ("render r --time 1.5", "--time"),
        ("render r --supersample 9", "--supersample"),
        ("render r --path still --time 0.5", "--path still stops the camera; drop one"),
        ("render r --output flow --frames 1", "--frames 1 has no next"),
        ("render r --view a", "--view needs a --path"),
        ("export r --format obj --out o", "--format"),
        ("export r --format ply --time 1.5 --out o", "--time"),
        ("benchmark", "missing command"),
        ("benchmark scenes --out o --steps 3", "SCENE"),
        ("benchmark scenes a --out o", "--budget 8m or --steps N"),
        ("doctor extra", "extra"),
        ("weights --to o", "--to is where --fetch downloads to"),
    ],
)
def test_usage_errors_are_one_line_and_exit_2(
    line: str, message: str, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    assert gsdmsr(line) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert error.count("\n") == 1
    assert message in error
    assert gsdmsr.calls == []


@pytest.mark.parametrize(
    ("failure", "code", "message"),
    [
        (GsdmsrError("general"), 1, "general"),
        (UsageError("two\nlines"), 2, "two lines"),
        (DataError("d/x.png: truncated"), 3, "d/x.png: truncated"),
        (ThresholdError("psnr"), 4, "psnr"),
        (
            OSError(errno.ENOSPC, "No space left on device", "r/a"),
            3,
            "r/a: No space left on device; free space or choose another place",
        ),
        (
            PermissionError(errno.EACCES, "Permission denied"),
            3,
            "Permission denied; free space or choose another place",
        ),
        (
            torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB"),
            3,
            "the GPU's memory is full; lower --set training.views_per_step=..., --set "
            "data.cache_mib=... or --set density.cap=..., raise --downscale, or use --device cpu",
        ),
        (
            ZeroDivisionError("division by zero"),
            1,
            "internal: ZeroDivisionError: division by zero (set GSDMSR_DEBUG=1 for the traceback)",
        ),
    ],
)
def test_failures_are_one_line_and_their_code(
    failure: Exception, code: int, message: str, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    gsdmsr.failure = failure
    assert gsdmsr("doctor") == code
    assert capsys.readouterr() == ("", f"error: {message}\n")
    assert gsdmsr("doctor --json") == code
    out, err = capsys.readouterr()
    kinds = {1: "internal", 2: "usage", 3: "data", 4: "threshold"}
    assert err == f"error: {message}\n"
    assert json.loads(out) == {
        "error": {"kind": kinds[code], "message": message, "exit_code": code}
    }


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), typer.Abort()])
def test_an_interrupt_exits_130(
    failure: BaseException, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    gsdmsr.failure = failure
    assert gsdmsr("doctor") == 130
    assert capsys.readouterr() == ("", "")
    assert gsdmsr("doctor --json") == 130
    out, err = capsys.readouterr()
    assert (json.loads(out)["error"]["kind"], err) == ("interrupted", "")


def test_debug_shows_the_traceback(
    gsdmsr: Gsdmsr, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("GSDMSR_DEBUG", "1")
    gsdmsr.failure = ZeroDivisionError("division by zero")
    assert gsdmsr("doctor") == 1
    error = capsys.readouterr().err
    assert "Traceback" in error
    assert error.splitlines()[-1].startswith("error: internal: ZeroDivisionError")


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("a\x1b[31mb", r"a\x1b[31mb"),
        ("a\u202eb", r"a\u202eb"),
        ("a\udcff\udcfe", r"a\xff\xfe"),
        ("a\x9b", r"a\x9b"),
    ],
)
@pytest.mark.parametrize("command", ["train --data", "prepare", "eval", "render", "export"])
def test_names_that_would_steer_a_terminal_are_refused_by_name(
    gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str], command: str, name: str, shown: str
) -> None:
    assert gsdmsr(f"{command} {name}") == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith(f"error: {shown}: this argument has control characters")
    assert err.count("\n") == 1 and err.strip().isprintable()


def test_names_in_any_language_are_printable() -> None:
    for name in ("böse Überraschung", "写真\u3000集", "a\u00a0b", "👩\u200d👩", "نام"):
        assert is_printable(name) and one_line(name).split() == name.split()


def test_an_error_is_one_printable_line_whatever_it_names() -> None:
    assert str(DataError("a\nb: \x1b[2J\x07 is\r\n wrong")) == r"a b: \x1b[2J\x07 is wrong"


def test_whoever_had_the_signals_before_has_them_afterwards(gsdmsr: Gsdmsr) -> None:
    names = ("SIGINT", "SIGTERM", "SIGHUP")
    numbers = [getattr(signal, name) for name in names if hasattr(signal, name)]
    earlier = [signal.signal(number, lambda *_: None) for number in numbers]
    try:
        mine = [signal.getsignal(number) for number in numbers]
        assert gsdmsr("doctor") == 0
        assert [signal.getsignal(number) for number in numbers] == mine
    finally:
        for number, handler in zip(numbers, earlier, strict=True):
            signal.signal(number, handler)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGHUP")
@pytest.mark.parametrize("ignored", [False, True])
def test_a_terminal_that_is_closed_is_ctrl_c_unless_nohup_is_asked_for(ignored: bool) -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN if ignored else signal.SIG_DFL)
    try:
        with ctrl_c_that_spares_imports():
            try:
                signal.raise_signal(signal.SIGHUP)
                ended = False
            except KeyboardInterrupt:
                ended = True
        assert ended is not ignored
    finally:
        signal.signal(signal.SIGHUP, before)


def test_ctrl_c_while_a_kernel_returns_is_ctrl_c() -> None:
    """Numba's C code calls Python to return a tuple; an exception there was lost, or a crash."""
    ones = np.ones(1, np.float32)
    arguments = (np.ones((1, 2), np.float32), np.ones((1, 3), np.float32), ones, ones)
    signalled = 0

    def signal_once(frame: FrameType, event: str, _argument: object) -> None:
        nonlocal signalled
        if event == "call" and frame.f_code.co_name == "_numba_unpickle" and not signalled:
            signalled += 1
            signal.raise_signal(signal.SIGINT)

    with ctrl_c_that_spares_imports(), pytest.raises(KeyboardInterrupt):
        sys.setprofile(signal_once)
        try:
            bin_splats(*arguments, np.ones(1, np.int32), 8, 8)
            assert signalled
            time.sleep(10)
        finally:
            sys.setprofile(None)
