"""Runs command lines in this process, and gives back what they change in it."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator

import numba
import pytest
import torch

from gsdmsr_cli.cli.main import main
from gsdmsr_cli.evaluation import speed


@pytest.fixture(scope="module", autouse=True)
def threads_as_before() -> Iterator[None]:
    """Training says how many threads numba and torch use."""
    before = numba.get_num_threads(), torch.get_num_threads()
    yield
    numba.set_num_threads(before[0])
    torch.set_num_threads(before[1])


@pytest.fixture
def gsdmsr(monkeypatch: pytest.MonkeyPatch) -> Callable[..., int]:
    """Runs a command line and returns its exit code."""
    monkeypatch.setattr(speed, "SECONDS", 0.05)
    monkeypatch.delenv("GSDMSR_DEBUG", raising=False)

    def call(*words: object) -> int:
        monkeypatch.setattr(sys, "argv", ["gsdmsr", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
        assert isinstance(ended.value.code, int)
        return ended.value.code

    return call
