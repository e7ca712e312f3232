"""Each operation of a step that errs on a device is complained of by name."""

from __future__ import annotations

import time
from typing import Any

import cuda_shim
import pytest
import torch
from torch import Tensor

from gsdmsr_cli.backends.cuda import launch
from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.ops import displace as deformation
from gsdmsr_cli.ops import network, precision
from gsdmsr_cli.ops.network import half
from gsdmsr_cli.raster import _check_operations as check
from gsdmsr_cli.raster._check_operations import OPERATIONS, operations_disagreement

pytestmark = pytest.mark.usefixtures("kernels_on_the_cpu")

BROKEN = {
    ("planes", "collapse"): "reading plane grids",
    ("planes", "lookup"): "reading plane grids",
    ("planes", "lookup_backward"): "reading plane grids",
    ("planes", "spread"): "reading plane grids",
    ("planes_bf16", "lookup"): "reading plane grids in bf16",
    ("planes_bf16", "lookup_backward"): "reading plane grids in bf16",
    ("planes_fp16", "collapse"): "reading plane grids in fp16",
    ("planes_fp16", "lookup_backward"): "reading plane grids in fp16",
    ("planes", "space_penalty"): "the penalty of plane grids",
    ("planes", "time_penalty"): "the penalty of plane grids",
    ("hash_grid", "lookup_hashed"): "reading hash grids",
    ("hash_grid", "lookup_hashed_backward"): "reading hash grids",
    ("hash_grid", "lookup_hashed_slopes"): "reading hash grids",
    ("nearest", "nearest"): "the search for the nearest control points",
    ("skinning", "transform"): "the transforms of control points",
    ("skinning", "transform_backward"): "the transforms of control points",
    ("skinning", "skin"): "skinning splats",
    ("skinning", "skin_backward"): "skinning splats",
    ("series", "add_series"): "adding series",
    ("series", "add_series_backward"): "adding series",
    ("hats", "hats"): "shares of nodes in time",
    ("slices", "cut"): "slices of Gaussians in time",
    ("slices", "cut_backward"): "slices of Gaussians in time",
    ("cube_map", "show"): "colours behind splats",
    ("cube_map", "show_backward"): "colours behind splats",
    ("adam", "adam"): "Adam",
}


class Skipping:
    """Runs all kernels but one."""

    def __init__(self, shim: cuda_shim.Shim, source: str, kernel: str) -> None:
        self.shim, self.skipped = shim, (source, kernel)

    def launch(self, source: str, kernel: str, *given: Any) -> None:
        if (source, kernel) != self.skipped:
            self.shim.launch(source, kernel, *given)


def complaint() -> str:
    said = operations_disagreement("cpu")
    assert said is not None
    return said


def test_all_kernels_agree_with_their_twins_and_soon() -> None:
    assert operations_disagreement("cpu") is None
    started = time.process_time()
    assert operations_disagreement("cpu") is None
    assert time.process_time() - started < 5


@pytest.mark.parametrize(("source", "kernel"), BROKEN)
def test_a_kernel_that_does_nothing_is_complained_of_by_name(
    kernels_on_the_cpu: cuda_shim.Shim, monkeypatch: pytest.MonkeyPatch, source: str, kernel: str
) -> None:
    monkeypatch.setitem(launch.runners, "cpu", Skipping(kernels_on_the_cpu, source, kernel))
    # memory that nobody has written to may hold anything
    monkeypatch.setattr(torch.Tensor, "new_empty", torch.Tensor.new_zeros)
    monkeypatch.setattr(torch, "empty_like", torch.zeros_like)
    assert complaint().startswith(f"{BROKEN[source, kernel]} makes wrong ")


def doubled(tensor: Tensor) -> Tensor:
    """The same values, which pass on twice their gradient."""
    return 2 * tensor - tensor.detach()


def test_displacing_that_passes_on_wrong_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    right = deformation.displace

    def displace(splats: Any, offsets: Tensor, shift: Tensor) -> Any:
        wrong = offsets.dtype is torch.float32
        return right(splats, doubled(offsets) if wrong else offsets, shift)

    monkeypatch.setattr(deformation, "displace", displace)
    assert complaint() == "displacing splats makes wrong gradients of deformations of test values"


@pytest.mark.parametrize("forgotten", range(3))
def test_a_penalty_without_one_of_its_terms(
    monkeypatch: pytest.MonkeyPatch, forgotten: int
) -> None:
    right = check.planes.penalty

    def penalty(levels: Any, *weights: float) -> Tensor:
        given = list(weights)
        if levels[0].space.dtype is torch.float32:
            given[forgotten] = 0.0
        return right(levels, *given)

    monkeypatch.setattr(check.planes, "penalty", penalty)
    assert complaint() == "the penalty of plane grids makes wrong values of test values"


@pytest.mark.parametrize("name", ["float32", "bf16", "fp16"])
def test_networks_of_every_format(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    right, dtype = network.apply_network, precision.FORMATS[name]

    def apply_network(layers: Any, x: Tensor) -> Tensor:
        wrong = x.dtype is torch.float32 and precision.chosen() is dtype
        return right(layers, doubled(x) if wrong else x)

    monkeypatch.setattr(network, "apply_network", apply_network)
    said = "a network" if name == "float32" else f"a network in {name}"
    assert complaint() == f"{said} makes wrong gradients of inputs of test values"


def test_hidden_layers_are_computed_in_the_format(monkeypatch: pytest.MonkeyPatch) -> None:
    seen = []
    right = half.apply_network
    monkeypatch.setattr(
        half, "apply_network", lambda *given: (seen.append(given[2]), right(*given))[1]
    )
    assert operations_disagreement("cpu") is None
    assert seen == [torch.bfloat16, torch.float16]


@pytest.mark.parametrize("what", ["multipliers", "loss"])
def test_an_adam_that_does_not_heed(monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    right = check.adam

    def adam(rows: list[Any], beta1: float, beta2: float, eps: float, loss: Tensor) -> None:
        if what == "multipliers":
            for row in rows:
                if row.multipliers is not None:
                    row.multipliers.fill_(1.0)
        right(rows, beta1, beta2, eps, None if what == "loss" else loss)

    monkeypatch.setattr(check, "adam", adam)
    name = "Adam with multipliers" if what == "multipliers" else "Adam with a loss that is not"
    assert complaint().startswith(name)


def test_a_driver_that_fails_is_told_of(monkeypatch: pytest.MonkeyPatch) -> None:
    class Failing:
        def launch(self, *_: object) -> None:
            raise GsdmsrError("the NVIDIA driver failed when launching collapse\nno image (209)")

    monkeypatch.setitem(launch.runners, "cpu", Failing())
    assert complaint() == (
        "reading plane grids fails on test values: "
        "the NVIDIA driver failed when launching collapse no image (209)"
    )


def test_the_nearest_nodes_of_the_test_values_are_beyond_doubt() -> None:
    """No two are so equally far that rounding could choose between them."""
    points, control_points = check._random(check._COUNT, 3), check._random(check._POINTS, 3, seed=1)
    squares = (points[:, None].double() - control_points).square().sum(dim=2).sort(dim=1).values
    gaps = squares[:, check._NEAR] - squares[:, check._NEAR - 1]
    assert (gaps / squares[:, check._NEAR]).min() > 1e-5
    assert len(OPERATIONS) == 20
