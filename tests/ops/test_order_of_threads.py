"""Results depend neither on the order of threads nor on what memory held before."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import cuda_shim
import pytest
import torch
from kernel_checks import assert_near, generator, leaves
from motion_checks import splats_of
from skinning_checks import control_points_of, guesses
from torch import Tensor

from gsdmsr_cli.backends.cuda import compiler, launch
from gsdmsr_cli.benchmark.cloud import camera, cloud
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.measure import Measure
from gsdmsr_cli.ops import hash_grid, planes
from gsdmsr_cli.ops import skin as skinning
from gsdmsr_cli.ops.cube_map import show_behind
from gsdmsr_cli.ops.hash_grid import cuda as hashed
from gsdmsr_cli.ops.nearest import nearest_points
from gsdmsr_cli.ops.planes import cuda as grids
from gsdmsr_cli.ops.series import add_series
from gsdmsr_cli.ops.slices import slices
from gsdmsr_cli.raster import cuda

SIZE = 40
BACKGROUND = torch.tensor([0.2, 0.5, 0.9])


@pytest.fixture
def full_memory() -> Iterator[None]:
    """New memory is full of NaN, or of the largest integers."""
    assert torch.utils.deterministic.fill_uninitialized_memory
    torch.use_deterministic_algorithms(True)
    yield
    torch.use_deterministic_algorithms(False)


def splats(count: int) -> Splats:
    """More of them in a tile than a batch holds, and some outside of the picture."""
    made = cloud(count)
    means = 1.4 * made.means
    return Splats(**{**made.tensors(), "means": means}).map(lambda t: t.requires_grad_())


def drawing() -> list[Tensor]:
    some = splats(700)
    frame = cuda.rasterize(Moment(some), camera(SIZE), BACKGROUND, None, True)
    assert frame.depth is not None
    total = frame.rgb.square().sum() + frame.alpha.sum() + frame.depth.sum()
    gradients = torch.autograd.grad(total, list(some.tensors().values()))
    return [frame.rgb, frame.alpha, frame.depth, frame.radii, frame.means2d, *gradients]


def drawing_axes_and_features() -> list[Tensor]:
    rng = generator(3)
    axes = 0.1 * torch.randn(700, 3, 3, generator=rng)
    moment = Moment(splats(700), axes, torch.randn(700, 6, generator=rng))
    leaves = moment.map(lambda t: t.detach().requires_grad_())
    frame = cuda.rasterize(leaves, camera(SIZE), BACKGROUND)
    assert frame.features is not None
    total = frame.rgb.square().sum() + frame.features.square().sum()
    gradients = torch.autograd.grad(total, list(leaves.tensors().values()))
    return [frame.rgb, frame.features, frame.radii, frame.means2d, *gradients]


def comparing(ssim: float, weighted: bool = False) -> list[Tensor]:
    some, views = splats(500), [camera(SIZE), camera(SIZE)]
    shape = 3, SIZE, SIZE
    rng = generator(1)
    targets = [torch.randint(256, shape, generator=rng, dtype=torch.uint8) for _ in views]
    weights = [torch.arange(9.0), torch.ones(9)] if weighted else None
    loss, found = cuda.compare_views(
        [Moment(some)] * 2, views, BACKGROUND, targets, Measure(ssim), tile_weights=weights
    )
    gradients = torch.autograd.grad(loss, list(some.tensors().values()))
    errors = [view.errors for view in found if view.errors is not None]
    return [loss, *(view.on_screen for view in found), *errors, *gradients]


def looking_up(dtype: torch.dtype) -> list[Tensor]:
    rng = generator(2)
    levels = [planes.new_level(r, 4, 16, rng) for r in (3, 8)]
    tensors = [tensor.requires_grad_() for level in levels for tensor in level]
    points = torch.randn(100, 3, generator=rng).requires_grad_()
    given = points, torch.ones(100, 2), [0.3, -0.5], [[1.0] * 3, [0.0] * 3], tensors
    features = grids.lookup(*given, dtype)
    value = grids.penalty((0.1, 0.2, 0.3), tensors)
    total = features.square().sum() + value
    return [features, value, *torch.autograd.grad(total, [points, *tensors])]


def looking_up_hashed() -> list[Tensor]:
    levels = hash_grid.Levels(((5, 4, 3), (17, 12, 9)), 128)
    table = torch.randn(levels.offsets[-1], 2, generator=generator(2)).requires_grad_()
    points = torch.randn(300, 3, generator=generator(3)).requires_grad_()
    features = hashed.lookup(levels, table, points)
    return [features, *torch.autograd.grad(features.square().sum(), [table, points])]


def adding_series() -> list[Tensor]:
    rng = generator(2)
    own = [torch.randn(300, *s, generator=rng).requires_grad_() for s in ((4,), (5, 3), (3,))]
    found = add_series(*own, 1.3, 1)
    return [found, *torch.autograd.grad(found[40:].square().sum(), own)]


def slicing() -> list[Tensor]:
    rng = generator(2)
    own = [torch.randn(300, *s, generator=rng).requires_grad_() for s in ((4,), (3,), (4,), ())]
    cut = slices(*own)
    total = sum(part[40:].square().sum() for part in (cut.velocities, cut.axes))
    return [*cut, *torch.autograd.grad(total, own)]


def showing_behind() -> list[Tensor]:
    rng = generator(2)
    own = [torch.rand(s, generator=rng).requires_grad_() for s in ((SIZE, SIZE, 3), (SIZE, SIZE))]
    own.append(torch.rand(96, 3, generator=rng).requires_grad_())
    found = show_behind(*own, torch.arange(96).view(6, 4, 4), camera(SIZE))
    return [found, *torch.autograd.grad(found.square().sum(), own)]


def following() -> list[Tensor]:
    """Splats that follow control points, of which some are given no gradient."""
    splats, (points, log_radii, deformation) = splats_of(150), control_points_of(45)
    stored = [splats.means, splats.quats, splats.log_scales]
    own = leaves([*stored, points, log_radii, deformation], torch.float32)
    near = nearest_points(stored[0], points, guesses(150, 8))
    moving = replace(splats, means=own[0], quats=own[1], log_scales=own[2])
    made = skinning.transforms(own[3], own[5])
    moved = skinning.skin(moving, own[3], own[4], made, near)
    total = moved.means[40:].square().sum() + moved.quats[40:].square().sum()
    total = total + moved.log_scales[40:].square().sum()
    return [near, made, moved.means, moved.quats, *torch.autograd.grad(total, own)]


WORKS: dict[str, Callable[[], list[Tensor]]] = {
    "drawing": drawing,
    "drawing axes and features": drawing_axes_and_features,
    "L1": lambda: comparing(0.0),
    "L1, weighted tiles": lambda: comparing(0.0, weighted=True),
    "L1 and SSIM": lambda: comparing(0.2),
    "control_points": following,
    "plane grids": lambda: looking_up(torch.float32),
    "hash grids": looking_up_hashed,
    "series": adding_series,
    "slices": slicing,
    "cube map": showing_behind,
    "plane grids in bf16": lambda: looking_up(torch.bfloat16),
    "plane grids in fp16": lambda: looking_up(torch.float16),
}


@pytest.mark.usefixtures("full_memory")
@pytest.mark.parametrize("name", WORKS)
def test_results_do_not_depend_on_turns(name: str, kernels_on_the_cpu: cuda_shim.Shim) -> None:
    """But for the last bits of sums, which are added up in the order of turns."""
    forwards = WORKS[name]()
    kernels_on_the_cpu.backwards = True
    try:
        backwards = WORKS[name]()
    finally:
        kernels_on_the_cpu.backwards = False
    for i, (one, other) in enumerate(zip(forwards, backwards, strict=True)):
        assert one.isfinite().all(), i
        assert_near(one, other, 2e-5, f"result {i}")


@pytest.mark.parametrize(("barrier", "same"), [("__syncthreads();", True), ("", False)])
def test_a_missing_barrier_is_seen(
    barrier: str, same: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All threads read what the first one has written."""
    if cuda_shim.MISSING:
        pytest.skip(cuda_shim.MISSING)
    text = f"""extern "C" __global__ void f(int *out) {{
        __shared__ int first;
        if (threadIdx.x == 0) first = 7 + blockIdx.x;
        {barrier}
        out[blockIdx.x * blockDim.x + threadIdx.x] = first;
    }}"""
    (tmp_path / "some.cu").write_text(text, encoding="utf-8")
    monkeypatch.setattr(compiler, "ROOT", tmp_path)
    results = []
    with cuda_shim.on_the_cpu(tmp_path) as shim:
        for shim.backwards in (False, True):
            results.append(torch.zeros(128, dtype=torch.int32))
            launch.launch("some", "f", (2, 1), 64, results[-1])
    assert torch.equal(results[0], torch.tensor([7, 8]).repeat_interleave(64).int())
    assert torch.equal(*results) == same
