"""Why there is no CUDA here is said in one clause, with the remedy."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch

from gsdmsr_cli import raster
from gsdmsr_cli.backends.cuda import availability, launch
from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.errors import DataError, GsdmsrError
from gsdmsr_cli.ops.rasterize.cuda import room
from gsdmsr_cli.raster import _check, cpu, cuda


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> pytest.MonkeyPatch:
    """A machine on which nothing is missing, to take things away from."""
    monkeypatch.setattr(availability, "built_for", lambda: 13)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda: (9, 0))
    monkeypatch.setattr(availability, "load_nvrtc", lambda _: object())
    monkeypatch.setattr(cuda, "_disagreement", lambda: None)
    return monkeypatch


def test_nothing_is_missing_where_all_is_there(machine: pytest.MonkeyPatch) -> None:
    assert availability.missing() is None
    assert raster.pick_device("auto") == raster.pick_device("cuda") == "cuda"
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
    assert raster.pick_device("auto") == "cpu"
    with pytest.raises(DataError, match=r"^--device cuda: torch finds no .*; use --device cpu$"):
        raster.pick_device("cuda")


def test_the_engine_does_not_draw_in_the_memory_of_the_cpu() -> None:
    assert "memory of a GPU" in str(raster.load_engine("cuda").unavailable("cpu"))


def test_a_gpu_that_draws_otherwise_is_not_relied_on(machine: pytest.MonkeyPatch) -> None:
    machine.setattr(cuda, "_disagreement", lambda: "the picture of a test drawing is wrong")
    assert raster.pick_device("auto") == "cpu"
    with pytest.raises(DataError, match="the picture of a test drawing is wrong; use --device cpu"):
        raster.pick_device("cuda")


def test_a_healthy_engine_agrees_with_the_reference() -> None:
    assert _check.disagreement(cpu.rasterize, cpu.compare, "cpu") is None


def mistaken(name: str) -> Callable[..., Frame]:
    """Return an engine that takes one of the stored tensors for half, but learns it rightly."""

    def draw(moment: Moment, *rest: Any) -> Frame:
        tensor = getattr(moment.splats, name)
        off = 0.5 * tensor.detach()
        if name == "sh":
            off[:, 0] = 0  # the constant part is as it should be
        wrong = replace(moment.splats, **{name: tensor - off})
        return cpu.rasterize(replace(moment, splats=wrong), *rest)

    return draw


@pytest.mark.parametrize("name", ["means", "log_scales", "logit_opacities", "sh"])
def test_an_engine_that_mistakes_any_of_the_stored_tensors_is_found_out(name: str) -> None:
    said = _check.disagreement(mistaken(name), cpu.compare, "cpu")
    assert said == "the picture of a test drawing is wrong"


@pytest.mark.usefixtures("kernels_on_the_cpu")
def test_the_kernels_agree_with_the_reference() -> None:
    assert _check.disagreement(cuda.rasterize, cuda.compare, "cpu") is None


def test_kernels_that_do_nothing_are_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    class Nobody:
        def launch(self, *_: object) -> None:
            pass

    monkeypatch.setitem(launch.runners, "cpu", Nobody())
    monkeypatch.setattr(room.Room, "find", lambda *_: 1)
    # memory that nobody has written to may hold anything
    monkeypatch.setattr(torch.Tensor, "new_empty", torch.Tensor.new_zeros)
    assert (
        _check.disagreement(cuda.rasterize, cuda.compare, "cpu")
        == "the picture of a test drawing is wrong"
    )


def doubled(moment: Moment) -> Moment:
    """The same values, whose rotations get twice their gradient."""
    quats = moment.splats.quats
    return replace(moment, splats=replace(moment.splats, quats=2 * quats - quats.detach()))


def test_wrong_gradients_of_drawing_are_found_out() -> None:
    wrong = _check.disagreement(
        lambda moment, *given: cpu.rasterize(doubled(moment), *given), cpu.compare, "cpu"
    )
    assert wrong == "the gradient of quats by the picture of a test drawing is wrong"


def test_wrong_gradients_of_comparing_are_found_out() -> None:
    wrong = _check.disagreement(
        cpu.rasterize, lambda moment, *given: cpu.compare(doubled(moment), *given), "cpu"
    )
    assert wrong == "the gradient of quats by the loss of a test drawing is wrong"


def test_a_wrong_loss_is_found_out() -> None:
    def compare(*given: Any) -> raster.Comparison:
        found = cpu.compare(*given)
        return found._replace(loss=found.loss * 1.01)

    wrong = _check.disagreement(cpu.rasterize, compare, "cpu")
    assert wrong == "the loss of a test drawing is wrong"


@pytest.mark.parametrize(
    ("name", "broken"),
    [
        ("SSIM loss", lambda measure, weights: measure.ssim > 0),
        ("loss of squares", lambda measure, weights: measure.quadratic > 0),
        ("loss of weighted tiles", lambda measure, weights: weights is not None),
    ],
)
def test_every_loss_is_looked_at(name: str, broken: Callable[..., bool]) -> None:
    """Its value, and its gradients."""

    def compare(moment: Moment, *given: Any) -> raster.Comparison:
        wrong = broken(given[3], given[5])
        found = cpu.compare(doubled(moment) if wrong and slopes else moment, *given)
        return found if slopes or not wrong else found._replace(loss=1.01 * found.loss)

    for slopes in (False, True):
        what = f"the gradient of quats by the {name}" if slopes else f"the {name}"
        said = _check.disagreement(cpu.rasterize, compare, "cpu")
        assert said == f"{what} of a test drawing is wrong"


def test_a_driver_that_fails_is_told_of() -> None:
    def draw(*_: object) -> None:
        raise GsdmsrError("the NVIDIA driver failed when launching project: no image (209)")

    said = _check.disagreement(draw, cpu.compare, "cpu")
    assert said is not None and said.startswith("it fails a test drawing: the NVIDIA driver failed")
