"""Why there is no CUDA here is said in one clause, with the remedy."""

from __future__ import annotations

import pytest
import torch

from gsdmsr_cli import raster
from gsdmsr_cli.cuda import availability
from gsdmsr_cli.errors import DataError


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """A machine on which nothing is missing, to take things away from."""
    monkeypatch.setattr(availability, "built_for", lambda: 13)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (9, 0))
    monkeypatch.setattr(availability, "load_nvrtc", lambda _: object())
    return monkeypatch


def test_nothing_is_missing_where_all_is_there(machine: pytest.MonkeyPatch) -> None:
    assert availability.missing() is None
    assert raster.best_engine("cuda") is raster.load_engine("cuda")


def test_a_torch_without_cuda(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(availability, "built_for", lambda: None)
    assert "built without CUDA" in str(availability.missing())


def test_no_card(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(torch.cuda, "is_available", lambda: False)
    assert "nvidia-smi" in str(availability.missing())


def test_an_old_card(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(torch.cuda, "get_device_capability", lambda: (7, 0))
    assert "7.0, and 7.5 is the least" in str(availability.missing())


def test_no_compiler(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(availability, "load_nvrtc", lambda _: None)
    assert "NVRTC of CUDA 13 is missing; pip install 'gsdmsr[cuda]'" in str(availability.missing())


def test_a_wish_for_cuda_is_refused_in_one_line(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(DataError, match=r"^--device cuda: torch finds no .*; use --device cpu$"):
        raster.pick_device("cuda")


def test_the_engine_does_not_draw_in_the_memory_of_the_cpu() -> None:
    assert "memory of a GPU" in str(raster.load_engine("cuda").unavailable("cpu"))
