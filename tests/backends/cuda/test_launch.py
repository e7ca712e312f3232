"""What kernels are handed: addresses of contiguous tensors, C's numbers, structures by value."""

from __future__ import annotations

import ctypes

import pytest
import torch

from gsdmsr_cli.backends.cuda import launch


class Recorder:
    """Notes what it is to run."""

    def __init__(self) -> None:
        self.seen: list[tuple[object, ...]] = []

    def launch(self, source, kernel, grid, block, arguments, device) -> None:
        raw = [
            ctypes.string_at(address, 8 if i in (0, 3) else 4)
            for i, address in enumerate(arguments)
        ]
        self.seen.append((source, kernel, grid, block, raw, device.type))


@pytest.fixture
def recorder(monkeypatch: pytest.MonkeyPatch) -> Recorder:
    recorder = Recorder()
    monkeypatch.setitem(launch.runners, "cpu", recorder)
    return recorder


def test_arguments_are_handed_over_as_c_does(recorder: Recorder) -> None:
    tensor = torch.arange(3.0)
    launch.launch("a", "b", (2, 1), 64, tensor, 7, 0.5, None)
    (seen,) = recorder.seen
    assert seen[:4] == ("a", "b", (2, 1), 64) and seen[5] == "cpu"
    pointer, seven, half, null = seen[4]
    assert int.from_bytes(pointer, "little") == tensor.data_ptr()
    assert int.from_bytes(seven, "little") == 7
    assert ctypes.c_float.from_buffer_copy(half).value == 0.5
    assert null == bytes(8)


def test_an_empty_grid_launches_nothing(recorder: Recorder) -> None:
    launch.launch("a", "b", (0, 3), 64, torch.zeros(1))
    assert not recorder.seen


def test_strided_tensors_are_refused(recorder: Recorder) -> None:
    with pytest.raises(ValueError, match="contiguous"):
        launch.launch("a", "b", (1, 1), 64, torch.zeros(2, 3).T)


def test_without_a_tensor_there_is_no_device(recorder: Recorder) -> None:
    with pytest.raises(ValueError, match="no tensor"):
        launch.launch("a", "b", (1, 1), 64, 1)


def test_structures_have_the_layout_of_c() -> None:
    tensor = torch.zeros(1)
    packed = launch.struct(1, tensor, 2.0)
    assert ctypes.sizeof(packed) == 24  # the pointer is aligned
    assert int.from_bytes(bytes(packed)[8:16], "little") == tensor.data_ptr()


@pytest.mark.parametrize(("count", "expected"), [(0, 0), (1, 1), (256, 1), (257, 2)])
def test_every_item_has_a_thread(count: int, expected: int) -> None:
    assert launch.blocks(count, 256) == expected


def test_who_serves_whom() -> None:
    here, there = torch.zeros(1), torch.zeros(1, device="meta")
    assert not launch.serves(here)  # unless a test lends the CPU a runner
    assert not launch.serves(there)


def test_a_runner_serves_float32_on_its_own_device_alone(recorder: Recorder) -> None:
    here, there = torch.zeros(1), torch.zeros(1, device="meta")
    assert launch.serves(here, here)
    assert not launch.serves(here.double())
    assert not launch.serves(here, there)
