"""Plane lookups and penalties on CUDA kernels are their plain torch twins in float64.

So are lookups of grids in half precision, where the twin's grids are rounded in the same way.
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from pathlib import Path

import cuda_shim
import pytest
import torch
from kernel_checks import assert_near, generator, leaves
from torch import Tensor

from gsdmsr_cli.backends.cuda import compiler, launch
from gsdmsr_cli.backends.cuda.compiler import MOST_LEVELS, MOST_VIEWS
from gsdmsr_cli.ops import planes, precision
from gsdmsr_cli.ops.planes import cuda as grids

pytestmark = pytest.mark.usefixtures("kernels_on_the_cpu")

BOX = (-1.0, -2.0, -0.5), (1.5, 1.0, 2.0)
TOLERANCE = 2e-5

HALVES = [torch.bfloat16, torch.float16]
halves = pytest.mark.parametrize("dtype", HALVES, ids=str)


def half_tolerance(dtype: torch.dtype) -> float:
    """At most half of what rounding does, see ``test_half_precision_is_used_where_it_is_chosen``.

    More than float32 needs: on a GPU products and sums are fused, so that a line near the
    middle of two numbers of the format may be rounded to the other one than in the twin.
    """
    return torch.finfo(dtype).eps / 8


def levels(*shapes: tuple[int, int, int], seed: int = 0) -> list[planes.Level]:
    """Levels of (resolution, times, channels), whose temporal planes are not 1 either."""
    rng = generator(seed)
    made = [planes.new_level(*shape, rng) for shape in shapes]
    return [level._replace(time=level.time + 0.3 * torch.randn(level.time.shape, generator=rng))
            for level in made]  # fmt: skip


def tensors_of(some: list[planes.Level]) -> list[Tensor]:
    return [tensor for level in some for tensor in level]


def levels_of(tensors: list[Tensor]) -> list[planes.Level]:
    return [planes.Level(*pair) for pair in zip(tensors[::2], tensors[1::2], strict=True)]


def points(count: int) -> Tensor:
    """Points in the box and around it."""
    return 1.6 * torch.randn(count, 3, generator=generator(3))


def rounded(level: planes.Level, time: float, dtype: torch.dtype) -> planes.Level:
    """What kernels read of a level at one time: its spatial planes, and lines at all times.

    Gradients go through the rounding as if there were none.
    """
    space, planes_of_time = level.space, level.time
    rounded = space + (space.float().to(dtype) - space).detach()
    last = planes_of_time.shape[2] - 1
    u = (torch.tensor(time).clamp(-1, 1) + 1) * 0.5 * last
    lower = min(int(u), last - 1)
    low, high = planes_of_time[:, :, lower], planes_of_time[:, :, lower + 1]
    exact = low + (high - low) * (u - lower)
    # rounded from float32, as the kernel does
    line = low.float() + (high.float() - low.float()) * (u - lower)
    line = exact + (line.to(dtype) - exact).detach()
    return planes.Level(rounded, torch.stack([line, line], dim=2))


def compare(
    place: str,
    some: list[planes.Level],
    count: int,
    times: Sequence[float],
    beside: int = 0,
    dtype: torch.dtype = torch.float32,
    degree: int = 1,
) -> None:
    half = dtype is not torch.float32
    tolerance = half_tolerance(dtype) if half else TOLERANCE
    given = [points(count), torch.randn(count, beside, generator=generator(4)), *tensors_of(some)]
    ours, exact = leaves(given, torch.float32), leaves(given, torch.float64)
    to_cube = planes.to_cube(BOX).tolist()
    there = [tensor.to(place) for tensor in ours]
    given_times = times, to_cube, there[2:], dtype
    found = grids.lookup(*there[:2], *given_times, degree=degree).cpu()
    assert found.dtype is torch.float32
    parts = []
    for time in times:
        read = levels_of(exact[2:])
        read = [rounded(level, time, dtype) for level in read] if half else read
        parts.append(planes.lookup_twin(read, exact[0], time, BOX, exact[1], degree))
    expected = torch.cat(parts)
    assert_near(found, expected, tolerance, "features")
    slope = torch.randn(expected.shape, generator=generator(5))
    slope[::3] = 0  # rows that nothing is to be learnt from
    found.backward(slope)
    expected.backward(slope.double())
    names = ["points", "beside", *(f"tensor {i}" for i in range(len(exact) - 2))]
    for name, one, other in zip(names, ours, exact, strict=True):
        assert_near(one.grad, other.grad, tolerance, name)


@pytest.mark.parametrize("time", [-1.0, -0.37, 0.0, 1.0, 1.4])
def test_features_and_gradients_at_all_times(place: str, time: float) -> None:
    compare(place, levels((5, 4, 16)), 33, [time])


@pytest.mark.parametrize("count", [1, 15, 16, 17, 300])
def test_any_number_of_points(place: str, count: int) -> None:
    compare(place, levels((4, 3, 32), (9, 5, 16)), count, [0.2], beside=3)


@pytest.mark.parametrize("times", [(0.3, 0.3), (-1.0, 0.1, 1.0, 0.4, -0.2)], ids=str)
@pytest.mark.parametrize("count", [1, 32])
def test_several_times_at_once(place: str, count: int, times: tuple[float, ...]) -> None:
    """Also where nothing is to be learnt from a point at one time, but from others."""
    compare(place, levels((4, 3, 32), (9, 5, 16)), count, times, beside=3)


@pytest.mark.parametrize("nodes", [2, 3, 4, 7])
def test_cubic_curves_in_time(place: str, nodes: int) -> None:
    times = (-1.0, -0.9, 0.1, 0.96, 1.0)
    compare(place, levels((4, nodes, 32), (9, 5, 16)), 33, times, beside=3, degree=3)


def test_no_points_have_no_features_and_teach_nothing() -> None:
    own = leaves(tensors_of(levels((4, 3, 16))), torch.float32)
    to_cube = planes.to_cube(BOX).tolist()
    features = grids.lookup(torch.zeros(0, 3), torch.zeros(0, 2), [0.0, 1.0], to_cube, own)
    assert features.shape == (0, 18)
    features.sum().backward()
    for tensor in own:
        assert tensor.grad is not None and not tensor.grad.any()


def test_the_smallest_grid(place: str) -> None:
    compare(place, levels((2, 2, 16)), 20, [0.5])


def test_points_that_need_no_gradient_get_none() -> None:
    own = leaves(tensors_of(levels((4, 3, 16))), torch.float32)
    given = points(20)
    to_cube = planes.to_cube(BOX).tolist()
    grids.lookup(given, torch.zeros(20, 0), [0.1], to_cube, own).sum().backward()
    assert given.grad is None
    assert own[0].grad is not None and own[0].grad.any()


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_points_that_are_nowhere_add_nothing_where_nothing_is_to_be_learnt(
    place: str, value: float
) -> None:
    given, nowhere = points(40), torch.tensor([3, 17, 38])
    given[nowhere, torch.tensor([0, 1, 2])] = value
    there = torch.ones(40, dtype=torch.bool).index_fill_(0, nowhere, False)
    to_cube, results = planes.to_cube(BOX).tolist(), []
    for rows in (slice(None), there):
        own = leaves([given[rows], *tensors_of(levels((4, 3, 16), (9, 5, 32)))], torch.float32)
        inputs, *tensors = [tensor.to(place) for tensor in own]
        features = grids.lookup(inputs, inputs.new_empty(len(inputs), 0), [0.1], to_cube, tensors)
        features.backward(there[rows, None].float().to(place).expand_as(features))
        results.append([tensor.grad for tensor in own])
    (d_points, *shared), (d_finite, *alone) = results
    assert_near(d_points[there], d_finite, TOLERANCE, "points")
    assert not d_points[nowhere].any()
    for ours, truth in zip(shared, alone, strict=True):
        assert_near(ours, truth, TOLERANCE, "shared")


@halves
@pytest.mark.parametrize("time", [-1.0, -0.37, 0.2, 1.4])
def test_half_precision(place: str, time: float, dtype: torch.dtype) -> None:
    compare(place, levels((4, 3, 32), (9, 5, 16)), 300, [time, 0.5], beside=3, dtype=dtype)


@halves
def test_half_precision_is_used_where_it_is_chosen(dtype: torch.dtype) -> None:
    """What rounding does to features is twice what the tests above allow, or more."""
    some = levels((4, 3, 32), (9, 5, 16))
    given = points(300), torch.zeros(300, 0), [0.2], planes.to_cube(BOX).tolist(), tensors_of(some)
    whole = grids.lookup(*given)
    with precision.computing_in({torch.bfloat16: "bf16", torch.float16: "fp16"}[dtype]):
        halved = planes.lookup(some, given[0], 0.2, BOX)
    assert torch.equal(halved, grids.lookup(*given, dtype))
    error = (halved - whole).norm() / whole.norm()
    assert 2 * half_tolerance(dtype) < error < torch.finfo(dtype).eps
    assert torch.equal(planes.lookup(some, given[0], 0.2, BOX), whole)


def test_tiny_gradients_reach_grids_of_half_precision() -> None:
    for dtype in HALVES:
        some = [tensor.requires_grad_() for tensor in tensors_of(levels((4, 3, 16)))]
        given = points(20), torch.zeros(20, 0), [0.2], planes.to_cube(BOX).tolist(), some
        features = grids.lookup(*given, dtype)
        slope = torch.rand(features.shape, generator=generator(5))
        whole, tiny = (torch.autograd.grad(features, some, slope * by, retain_graph=True)
                       for by in (1, 2.0**-27))  # fmt: skip
        for one, other in zip(whole, tiny, strict=True):
            assert one.any() and torch.equal(one, other * 2**27)


def test_numbers_are_read_and_rounded_as_torch_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All numbers of both formats; and for writing, those and what lies just beside and between."""
    shutil.copy(compiler.headers()["number_formats.cuh"], tmp_path)
    kernels = [
        f"""extern "C" __global__ void {name}({name} *stored, float *values, int n, int write) {{
            int i = blockIdx.x * 256 + threadIdx.x;
            if (i < n && write) store(stored + i, values[i]);
            if (i < n && !write) values[i] = load(stored + i);
        }}\n"""
        for name in ("Bf16", "Fp16")
    ]
    (tmp_path / "some.cu").write_text('#include "number_formats.cuh"\n' + "".join(kernels))
    monkeypatch.setattr(compiler, "ROOT", tmp_path)
    with cuda_shim.on_the_cpu(tmp_path):
        for name, dtype in zip(("Bf16", "Fp16"), HALVES, strict=True):
            stored = torch.arange(-(1 << 15), 1 << 15).to(torch.int16).view(dtype)
            values = torch.full(stored.shape, math.pi)
            run(name, stored, values, write=0)
            torch.testing.assert_close(values, stored.float(), rtol=0, atol=0, equal_nan=True)
            between = (values + torch.roll(values, 1)) / 2
            further = [torch.tensor([1e38, -3.4e38, 65519.99, 65520.0, 1e-30, 2.0**-25, 0.0])]
            for base in (values, between):
                for towards in (math.inf, -math.inf):
                    further += [base, torch.nextafter(base, torch.tensor(towards))]
            written = torch.cat(further)
            stored = torch.zeros(written.shape, dtype=dtype)
            run(name, stored, written, write=1)
            expected = written.to(dtype)
            torch.testing.assert_close(stored, expected, rtol=0, atol=0, equal_nan=True)
            assert torch.equal(stored.signbit()[expected == 0], expected.signbit()[expected == 0])


def run(name: str, stored: Tensor, values: Tensor, write: int) -> None:
    count = len(values)
    launch.launch("some", name, (-(-count // 256), 1), 256, stored, values, count, write)


def test_too_many_levels_are_refused() -> None:
    many = tensors_of(levels(*[(2, 2, 16)] * (MOST_LEVELS + 1)))
    with pytest.raises(ValueError, match="at most 8"):
        grids.lookup(points(2), torch.zeros(2, 0), [0.0], planes.to_cube(BOX).tolist(), many)


def test_too_many_times_are_refused() -> None:
    given = points(2), torch.zeros(2, 0), [0.0] * (MOST_VIEWS + 1)
    with pytest.raises(ValueError, match="17 times; at most 16"):
        grids.lookup(*given, planes.to_cube(BOX).tolist(), tensors_of(levels((2, 2, 16))))


@pytest.mark.parametrize("shapes", [[(2, 2, 16)], [(5, 3, 32)], [(4, 7, 16), (9, 4, 16)]])
def test_penalties_and_their_gradients(place: str, shapes: list[tuple[int, int, int]]) -> None:
    given = tensors_of(levels(*shapes))
    ours, exact = leaves(given, torch.float32), leaves(given, torch.float64)
    found = grids.penalty((0.3, 0.7, 0.2), [tensor.to(place) for tensor in ours]).cpu()
    expected = planes.penalty_twin(levels_of(exact), 0.3, 0.7, 0.2)
    assert_near(found, expected, TOLERANCE, "value")
    (3 * found).backward()
    (3 * expected).backward()
    for i, (one, other) in enumerate(zip(ours, exact, strict=True)):
        assert_near(one.grad, other.grad, TOLERANCE, f"tensor {i}")
