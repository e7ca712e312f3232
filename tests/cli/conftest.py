"""A command line that runs in this process, with commands that record their arguments."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import pytest

from gsdmsr_cli import commands
from gsdmsr_cli.cli.main import main

COMMANDS = (
    "make", "prepare", "train", "view", "eval", "compare", "render", "export", "info", "demo",
    "presets", "doctor", "weights", "cache", "benchmark_kernels", "benchmark_scenes",
    "benchmark_resume", "benchmark_still", "benchmark_soak", "benchmark_reading",
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
            main()
        assert isinstance(ended.value.code, int)
        return ended.value.code


@pytest.fixture
def gsdmsr(monkeypatch: pytest.MonkeyPatch) -> Gsdmsr:
    monkeypatch.delenv("GSDMSR_DEBUG", raising=False)
    return Gsdmsr(monkeypatch)
