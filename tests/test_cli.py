"""The command line: what each command is called with, and how every error ends."""

from __future__ import annotations

import errno
import re
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
import typer

from gsdmsr_cli import __version__, cli, commands
from gsdmsr_cli.benchmark.trials import Terms
from gsdmsr_cli.errors import DataError, GsdmsrError, ThresholdError, UsageError
from gsdmsr_cli.evaluation.request import Demands, Output
from gsdmsr_cli.evaluation.request import Request as Evaluation
from gsdmsr_cli.filming.request import Request
from gsdmsr_cli.preset import load_preset

COMMANDS = (
    "prepare", "train", "eval", "render", "export", "demo", "doctor", "weights",
    "benchmark_kernels", "benchmark_scenes", "benchmark_resume", "benchmark_still",
)  # fmt: skip


class Gsdmsr:
    """Runs the command line in this process, with commands that record their arguments."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.monkeypatch = monkeypatch
        self.calls: list[tuple[str, tuple[Any, ...]]] = []
        self.failure: BaseException | None = None
        for name in COMMANDS:
            fake = SimpleNamespace(run=lambda *arguments, name=name: self.record(name, arguments))
            monkeypatch.setattr(commands, name, fake, raising=False)

    def record(self, name: str, arguments: tuple[Any, ...]) -> None:
        self.calls.append((name, arguments))
        if self.failure is not None:
            raise self.failure

    def __call__(self, line: str) -> int:
        self.monkeypatch.setattr(sys, "argv", ["gsdmsr", *line.split()])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        assert isinstance(ended.value.code, int)
        return ended.value.code


@pytest.fixture
def gsdmsr(monkeypatch: pytest.MonkeyPatch) -> Gsdmsr:
    monkeypatch.delenv("GSDMSR_DEBUG", raising=False)
    return Gsdmsr(monkeypatch)


def python(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, *arguments], capture_output=True, text=True, timeout=60, check=False
    )


def test_help_is_fast_and_lists_every_command() -> None:
    python("-m", "gsdmsr_cli.cli", "--help")  # the first run may compile
    start = time.perf_counter()
    done = python("-m", "gsdmsr_cli.cli", "--help")
    # about 0.25 s on an idle machine; the bound allows for a busy one
    assert time.perf_counter() - start < 2.0
    assert done.returncode == 0
    for name in ("train", "eval", "render", "export", "demo", "doctor", "benchmark"):
        assert name in done.stdout


def test_the_command_line_imports_nothing_heavy() -> None:
    heavy = ("torch", "numpy", "numba", "cv2", "yaml")
    done = python(
        "-c", f"import gsdmsr_cli.cli, sys; print([m for m in {heavy} if m in sys.modules])"
    )
    assert done.stdout.strip() == "[]"


def test_version(gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]) -> None:
    assert gsdmsr("--version") == 0
    assert capsys.readouterr().out == f"gsdmsr {__version__}\n"


@pytest.mark.parametrize(
    ("line", "name", "arguments"),
    [
        (
            "train --data d --out r",
            "train",
            (Path("d"), Path("r"), None, None, [], "auto", False, False),
        ),
        (
            "train --data d --out r --preset dnerf --config f.yaml --set a.b=1 --set a.c=2"
            " --device cpu --resume",
            "train",
            (Path("d"), Path("r"), "dnerf", Path("f.yaml"), ["a.b=1", "a.c=2"], "cpu", True, False),
        ),
        ("eval r", "eval", (Path("r"), Evaluation(), Demands(), Output(), None)),
        (
            "eval r --split val --background both --downscale 2 --lpips-weights w --lpips-inria"
            " --json --fail-under psnr=25 --fail-under ssim=0.9 --fail-over lpips_alex=0.1"
            " --baseline b.json --tolerance psnr=0.5 --junit j.xml --github-summary --out o"
            " --report --data d",
            "eval",
            (
                Path("r"),
                Evaluation("val", "both", 2, Path("w"), True),
                Demands(
                    ("psnr=25", "ssim=0.9"), ("lpips_alex=0.1",), Path("b.json"), ("psnr=0.5",)
                ),
                Output(Path("o"), True, Path("j.xml"), True, True),
                Path("d"),
            ),
        ),
        ("render r", "render", (Path("r"), Request(), None, None)),
        (
            "render r --path orbit --frames 9 --out o --data d",
            "render",
            (Path("r"), Request("orbit", 9), Path("o"), Path("d")),
        ),
        (
            "render r --path interpolate --view a --view test/b --time 0.5 --fps 24"
            " --output depth,rgb --video webm,mp4 --size 64x32 --supersample 2 --overwrite",
            "render",
            (
                Path("r"),
                Request(
                    "interpolate",
                    None,
                    ("a", "test/b"),
                    0.5,
                    24.0,
                    ("rgb", "depth"),
                    ("webm", "mp4"),
                    (64, 32),
                    None,
                    2,
                    True,
                ),
                None,
                None,
            ),
        ),
        (
            "render r --video none --scale 0.5",
            "render",
            (Path("r"), Request(videos=(), scale=0.5), None, None),
        ),
        (
            "export r --format ply --time 0.5 --out o",
            "export",
            (Path("r"), "ply", 0.5, None, Path("o")),
        ),
        (
            "export r --format ply-sequence --frames 3 --out o",
            "export",
            (Path("r"), "ply-sequence", None, 3, Path("o")),
        ),
        ("demo", "demo", (Path("gsdmsr-demo"),)),
        ("doctor --json", "doctor", (True,)),
        ("weights", "weights", ([], None, None, False)),
        (
            "weights --fetch vgg --fetch alex --to o --lpips-weights w --json",
            "weights",
            (["vgg", "alex"], Path("o"), Path("w"), True),
        ),
        ("benchmark kernels --yardstick y --json", "benchmark_kernels", (Path("y"), "cpu", True)),
        ("benchmark kernels --device cuda", "benchmark_kernels", (None, "cuda", False)),
        (
            "benchmark scenes a --out o --steps 9",
            "benchmark_scenes",
            ([Path("a")], Path("o"), ["dnerf"], [9], [0], Terms(1, "white", "test", None), False),
        ),
        (
            "benchmark scenes a b --out o --preset static --preset dnerf --budget 2m --budget 8m"
            " --seed 1 --seed 2 --downscale 2 --background black --split val --lpips-weights w"
            " --jobs 2 --json",
            "benchmark_scenes",
            (
                [Path("a"), Path("b")],
                Path("o"),
                ["static", "dnerf"],
                ["2m", "8m"],
                [1, 2],
                Terms(2, "black", "val", Path("w"), 2),
                True,
            ),
        ),
    ],
)
def test_commands_get_typed_arguments(
    line: str, name: str, arguments: tuple[Any, ...], gsdmsr: Gsdmsr
) -> None:
    assert gsdmsr(line) == 0
    assert gsdmsr.calls == [(name, arguments)]


def overrides_of(gsdmsr: Gsdmsr, options: str) -> list[str]:
    assert gsdmsr(f"train --data d --out r {options}") == 0
    overrides = gsdmsr.calls[-1][1][4]
    assert isinstance(overrides, list)
    return overrides


def test_the_convenience_options_of_train_become_overrides(gsdmsr: Gsdmsr) -> None:
    options = "--budget 8m --downscale 2 --background black --seed 7 --threads 3"
    preset = load_preset(None, None, overrides_of(gsdmsr, f"--set training.seed=5 {options}"))
    assert (preset.training.budget, preset.training.seed, preset.training.threads) == ("8m", 7, 3)
    assert (preset.data.downscale, preset.data.background) == (2, "black")


def test_steps_put_an_end_to_a_budget(gsdmsr: Gsdmsr) -> None:
    overrides = overrides_of(gsdmsr, "--set training.budget=8m --steps 50")
    training = load_preset(None, None, overrides).training
    assert (training.steps, training.budget) == (50, None)


def test_a_budget_without_a_unit_is_refused_as_text(gsdmsr: Gsdmsr) -> None:
    with pytest.raises(UsageError, match='budget is "8"; allowed: null'):
        load_preset(None, None, overrides_of(gsdmsr, "--budget 8"))


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
            "the GPU's memory is full; lower --set density.cap=..., raise --downscale, lower --set "
            "data.cache_mib=..., or use --device cpu",
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
    assert gsdmsr("doctor --json") == code
    assert capsys.readouterr() == ("", f"error: {message}\n")


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), typer.Abort()])
def test_an_interrupt_exits_130(failure: BaseException, gsdmsr: Gsdmsr) -> None:
    gsdmsr.failure = failure
    assert gsdmsr("doctor") == 130


def test_debug_shows_the_traceback(
    gsdmsr: Gsdmsr, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("GSDMSR_DEBUG", "1")
    gsdmsr.failure = ZeroDivisionError("division by zero")
    assert gsdmsr("doctor") == 1
    error = capsys.readouterr().err
    assert "Traceback" in error
    assert error.splitlines()[-1].startswith("error: internal: ZeroDivisionError")


ROOT = Path(__file__).parent.parent
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])


def examples(page: Path) -> list[str]:
    """Return the calls of gsdmsr in a page's blocks of code, but for those that tell of syntax."""
    blocks = re.findall(r"^```\w*\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    calls = (re.split(r"\s[#|]", line)[0].strip().removeprefix("- run: ") for line in lines)
    syntax = re.compile(r"\[|\s[A-Z]+\b")
    return [call for call in calls if call.startswith("gsdmsr ") and not syntax.search(call)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_command_line_understands_the_examples_in_pages(page: Path, gsdmsr: Gsdmsr) -> None:
    for call in examples(page):
        assert gsdmsr(call.removeprefix("gsdmsr ")) == 0, call
