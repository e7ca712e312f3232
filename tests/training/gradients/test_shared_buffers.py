"""Memory that processes share: a place for every tensor, whatever its type and its size."""

from __future__ import annotations

import multiprocessing
import sys

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_checks import disturbed, model_of, splats_of, started
from torch import Tensor
from training_checks import assert_same_tensors, copies

from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.training.gradients.shared_buffers import SharedBuffers

ALIGNED = 64
DTYPES = torch.bool, torch.uint8, torch.int16, torch.int64, torch.float16, torch.float32
CAPACITY = 11

some_parameters = st.lists(
    st.tuples(st.sampled_from(DTYPES), st.booleans(), st.lists(st.integers(1, 5), max_size=2)),
    min_size=1,
    max_size=6,
)


def parameters_of(kinds: list[tuple[torch.dtype, bool, list[int]]]) -> list[Parameter]:
    """Return buffers of 3 splats, or of all splats together."""
    return [
        Parameter(f"p{i}", torch.zeros([3, *shape] if per_splat else shape, dtype=dtype), per_splat)
        for i, (dtype, per_splat, shape) in enumerate(kinds)
    ]


def shape_at(parameter: Parameter, count: int) -> tuple[int, ...]:
    shape = tuple(parameter.tensor.shape)
    return (count, *shape[1:]) if parameter.per_splat else shape


@given(some_parameters, st.integers(0, CAPACITY))
@settings(deadline=None, max_examples=60)
def test_every_tensor_keeps_what_is_written_whatever_its_neighbours_hold(
    kinds: list[tuple[torch.dtype, bool, list[int]]], count: int
) -> None:
    parameters = parameters_of(kinds)
    buffers = SharedBuffers(parameters, CAPACITY, {"beside": 2})
    given: dict[str, Tensor] = {
        p.name: torch.full(shape_at(p, count), i + 1).to(p.tensor.dtype)
        for i, p in enumerate(parameters)
    }
    given["beside"] = torch.full((count, 2), -1.0)
    buffers.write(given)
    for name, tensor in given.items():
        place = buffers.tensor(name, tensor.shape)
        assert place.dtype == tensor.dtype and torch.equal(place, tensor), name
        assert place.data_ptr() % ALIGNED == 0, name


def test_there_is_room_for_as_many_splats_as_were_asked_for_and_no_more() -> None:
    rows = Parameter("rows", torch.zeros(3, 4, dtype=torch.int64), per_splat=True)
    shared = Parameter("shared", torch.zeros(6))
    buffers = SharedBuffers([rows, shared], CAPACITY, {"beside": 2})
    assert buffers.tensor("rows", (CAPACITY, 4)).shape == (CAPACITY, 4)
    assert buffers.tensor("beside", (CAPACITY, 2)).dtype == torch.float32
    with pytest.raises(ValueError, match=r"rows of shape \(12, 4\) has room for 44 values"):
        buffers.tensor("rows", (CAPACITY + 1, 4))
    with pytest.raises(ValueError, match="shared of shape"):
        buffers.tensor("shared", (7,))


def test_a_model_that_is_published_is_the_one_that_is_attached() -> None:
    """Also after a resize, and what one writes the other sees."""
    one, two = (model_of(splats_of(5), disturbed(started("multiscale", 5))) for _ in range(2))
    buffers = SharedBuffers(one.parameters(), CAPACITY)
    one.take(torch.tensor([4, 4, 1, 0, 2, 3, 1]), torch.zeros(7, dtype=torch.bool))
    before = copies(one.tensors())
    buffers.publish(one)
    two.become(7, 7)
    buffers.attach(two, [tensor.shape for tensor in one.tensors().values()])
    assert_same_tensors(copies(one.tensors()), before)
    assert_same_tensors(copies(two.tensors()), before)
    with torch.no_grad():
        for tensor in one.tensors().values():
            tensor += 1
    places = {name: tensor.data_ptr() for name, tensor in one.tensors().items()}
    buffers.publish(one)  # lies there already
    assert {name: tensor.data_ptr() for name, tensor in one.tensors().items()} == places
    assert_same_tensors(copies(two.tensors()), copies(one.tensors()))


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="processes are not forked there")
def test_what_a_forked_process_writes_is_seen_here() -> None:
    buffers = SharedBuffers([Parameter("x", torch.zeros(4))], 1)
    context = multiprocessing.get_context("fork")
    process = context.Process(target=buffers.tensor("x", (4,)).numpy().fill, args=(3.0,))
    process.start()
    process.join(60)
    assert process.exitcode == 0
    assert buffers.tensor("x", (4,)).tolist() == [3.0] * 4
