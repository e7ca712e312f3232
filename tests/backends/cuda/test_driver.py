"""What reaches the NVIDIA driver, by a library that stands in for it."""

from __future__ import annotations

import ctypes

import pytest
import torch

from gsdmsr_cli.backends.cuda import driver, launch
from gsdmsr_cli.ground.errors import GsdmsrError

CARD = torch.device("cuda", 1)
STREAM = 4_000_000_000_000


def seen(fake: ctypes.CDLL) -> list[str]:
    return fake.take_log().decode().split(";")[:-1]


def fill(count: int, factor: float) -> torch.Tensor:
    out, also = torch.zeros(count), torch.arange(float(count))
    three = launch.struct(out, count, 2.0)
    launch.launch("some", "fill", (5, 3), 128, three, also, factor, on=CARD)
    return out


def test_arguments_reach_the_kernel_and_the_launch_its_shape(fake: ctypes.CDLL) -> None:
    assert fill(4, 10.0).tolist() == [20.0, 21.0, 22.0, 23.0]
    launched = f"launch 1 5 3 1 128 1 1 0 {STREAM} 0"
    assert seen(fake) == ["device", "retain 41", "enter", "load", "fill", launched]


def test_programs_are_loaded_once_and_the_context_is_entered_every_time(fake: ctypes.CDLL) -> None:
    fill(1, 1.0)
    seen(fake)
    fill(1, 1.0)
    assert [what.split()[0] for what in seen(fake)] == ["enter", "launch"]


def test_what_the_driver_refuses_is_told_with_its_reason(fake: ctypes.CDLL) -> None:
    fake.fail_with(209)
    with pytest.raises(GsdmsrError, match=r"failed when loading some.cu: no image \(209\)"):
        fill(1, 1.0)


def test_without_a_compiler_there_is_a_remedy(
    fake: ctypes.CDLL, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(driver, "load_nvrtc", lambda major: None)
    with pytest.raises(GsdmsrError, match=r"pip install 'gsdmsr\[cuda\]'"):
        fill(1, 1.0)


@pytest.mark.parametrize(("version", "major"), [(None, None), ("12.8", 12), ("13.0", 13)])
def test_the_compiler_is_that_of_torch(
    version: str | None, major: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.version, "cuda", version)
    assert driver.built_for() == major
