"""Moments: which shapes fit, what is read, and that rows stay together."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from gsdmsr_cli.benchmark.cloud import cloud
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import NAMES


def moment(count: int = 5, features: int = 2) -> Moment:
    rng = torch.Generator().manual_seed(1)
    axes = torch.randn(count, 3, 3, generator=rng)
    return Moment(cloud(count), axes, torch.randn(count, features, generator=rng))


@pytest.mark.parametrize("shape", [(5, 3), (4, 3, 3), (5, 9), (5, 3, 4)])
def test_axes_are_a_matrix_for_each_splat(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"axes has shape .*, not \(5, 3, 3\)"):
        Moment(cloud(5), axes=torch.zeros(shape))


@pytest.mark.parametrize("shape", [(5,), (4, 2), (5, 0), (5, 2, 1)])
def test_features_are_a_row_for_each_splat(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"features has shape .*, not \(5, F\) with F >= 1"):
        Moment(cloud(5), features=torch.zeros(shape))


def test_tensors_are_those_that_a_drawing_depends_on() -> None:
    whole = moment()
    assert list(Moment(whole.splats).tensors()) == list(NAMES)
    assert list(whole.tensors()) == ["means", "logit_opacities", "sh", "axes", "features"]
    assert whole.tensors()["axes"] is whole.axes
    assert len(whole) == 5


def test_rows_are_taken_from_all_tensors() -> None:
    whole, rows = moment(), torch.tensor([3, 0, 3])
    taken = whole.take(rows)
    for name, tensor in (whole.tensors() | whole.splats.tensors()).items():
        found = (taken.tensors() | taken.splats.tensors())[name]
        assert torch.equal(found, tensor[rows]), name
    plain = Moment(whole.splats).take(rows)
    assert plain.axes is None and plain.features is None


def test_what_is_detached_has_the_same_values_without_a_graph() -> None:
    leaves = moment().map(Tensor.requires_grad_)
    for found, tensor in zip(
        leaves.detach().tensors().values(), leaves.tensors().values(), strict=True
    ):
        assert tensor.requires_grad and not found.requires_grad
        assert torch.equal(found, tensor)
