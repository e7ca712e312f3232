"""Several views at once are the views one by one; short lists lose the farthest splats."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.measure import Measure
from gsdmsr_cli.ground.splatting_constants import DILATION, tile_grid
from gsdmsr_cli.ops.photometric import photometric_loss_twin
from gsdmsr_cli.ops.rasterize.cuda import room, stages
from gsdmsr_cli.raster import cuda
from gsdmsr_cli.scene.camera import Camera, look_at

pytestmark = pytest.mark.usefixtures("kernels_on_the_cpu")

WIDTH, HEIGHT = 37, 29
BACKGROUND = torch.tensor([0.2, 0.5, 0.9])


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def camera(angle: float, width: int = WIDTH, height: int = HEIGHT) -> Camera:
    centre = 4 * np.array([math.cos(angle), math.sin(angle), 0.3])
    pose = look_at(centre, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return Camera(pose, width, width, width / 2, height / 2, width, height)


def splats(count: int, seed: int = 0) -> Splats:
    rng = generator(seed)
    made = Splats(
        means=0.6 * torch.randn(count, 3, generator=rng),
        quats=torch.randn(count, 4, generator=rng),
        log_scales=math.log(0.15) + 0.4 * torch.randn(count, 3, generator=rng),
        logit_opacities=torch.randn(count, generator=rng),
        sh=torch.randn(count, 4, 3, generator=rng),
    )
    return made.map(lambda t: t.requires_grad_())


def target(seed: int) -> Tensor:
    shape = 3, HEIGHT, WIDTH
    return torch.randint(256, shape, generator=generator(seed), dtype=torch.uint8)


def assert_near(found: Tensor, expected: Tensor, tolerance: float = 1e-4) -> None:
    assert found.shape == expected.shape
    error = (found.double() - expected.double()).norm()
    assert error <= tolerance * expected.double().norm() + 1e-9


@pytest.mark.parametrize("measure", [Measure(0.0), Measure(0.2), Measure(0.0, 0.2)])
@pytest.mark.parametrize("moves", [False, True], ids=["at rest", "moving"])
def test_views_at_once_are_the_views_one_by_one(place: str, measure: Measure, moves: bool) -> None:
    base = splats(70).map(lambda t: t.detach().to(place).requires_grad_())
    shifts = [torch.zeros(70, 3), 0.2 * torch.randn(70, 3, generator=generator(5)), torch.ones(3)]
    shifts = [shift.to(place) for shift in shifts]
    moments = [Moment(replace(base, means=base.means + s) if moves else base) for s in shifts]
    cameras = [camera(angle) for angle in (0.1, 1.0, 2.5)]
    targets = [target(seed).to(place) for seed in range(3)]
    leaves = list(base.tensors().values())
    together, views = cuda.compare_views(moments, cameras, BACKGROUND, targets, measure)
    found = torch.autograd.grad(together, leaves, retain_graph=True)
    expected = [torch.zeros_like(leaf) for leaf in leaves]
    for moment, where, wanted, view in zip(moments, cameras, targets, views, strict=True):
        alone = cuda.compare(moment, where, BACKGROUND, wanted, measure)
        assert_near(view.loss, alone.loss, 1e-6)
        assert_near(view.on_screen, alone.on_screen)
        assert (view.errors is None) == (alone.errors is None) == (measure.ssim > 0)
        if view.errors is not None and alone.errors is not None:
            assert_near(view.errors, alone.errors, 1e-6)
        for total, part in zip(
            expected, torch.autograd.grad(alone.loss, leaves, retain_graph=True), strict=True
        ):
            total += part
    for one, other in zip(found, expected, strict=True):
        assert_near(one, other)


@pytest.mark.parametrize("moves", [False, True], ids=["at rest", "moving"])
def test_axes_are_shared_by_views_or_their_own(place: str, moves: bool) -> None:
    base = splats(50).map(lambda t: t.detach().to(place).requires_grad_())
    axes = 0.15 * torch.randn(50, 3, 3, generator=generator(6))
    axes = axes.to(place).requires_grad_()
    moments = [Moment(base, axes * (1 + i) if moves else axes) for i in range(2)]
    cameras, targets = [camera(0.1), camera(1.0)], [target(s).to(place) for s in (0, 1)]
    leaves = [base.means, base.logit_opacities, base.sh, axes]
    together, _ = cuda.compare_views(moments, cameras, BACKGROUND, targets, Measure(0.0))
    found = torch.autograd.grad(together, leaves, retain_graph=True)
    expected = [torch.zeros_like(leaf) for leaf in leaves]
    for moment, where, wanted in zip(moments, cameras, targets, strict=True):
        alone = cuda.compare(moment, where, BACKGROUND, wanted, Measure(0.0))
        parts = torch.autograd.grad(alone.loss, leaves, retain_graph=True)
        for total, part in zip(expected, parts, strict=True):
            total += part
    for one, other in zip(found, expected, strict=True):
        assert one.any()
        assert_near(one, other)


def test_moments_with_axes_and_without_are_not_drawn_at_once() -> None:
    mixed = [Moment(splats(3)), Moment(splats(3), torch.eye(3).expand(3, 3, 3))]
    with pytest.raises(ValueError, match="with axes and without cannot be drawn at once"):
        cuda.compare_views(mixed, [camera(0.0)] * 2, BACKGROUND, [target(0)] * 2, Measure(0.0))


def test_every_view_has_its_own_tile_weights() -> None:
    base, cameras = splats(40), [camera(0.3), camera(1.3)]
    tiles = math.prod(tile_grid(WIDTH, HEIGHT))
    weights = [2 * torch.rand(tiles, generator=generator(s)) for s in (1, 2)]
    weights[0][1] = 0
    targets = [target(0), target(1)]
    _, views = cuda.compare_views(
        [Moment(base)] * 2, cameras, BACKGROUND, targets, Measure(0.0), tile_weights=weights
    )
    for where, wanted, own, view in zip(cameras, targets, weights, views, strict=True):
        alone = cuda.compare(
            Moment(base), where, BACKGROUND, wanted, Measure(0.0), tile_weights=own
        )
        assert_near(view.loss, alone.loss, 1e-6)
        assert_near(view.on_screen, alone.on_screen)


@pytest.mark.parametrize(
    "cameras",
    [[], [camera(0.0)] * 17, [camera(0.0), camera(0.0, WIDTH + 1)]],
    ids=["none", "too many", "of two sizes"],
)
def test_views_that_cannot_be_drawn_at_once_are_refused(cameras: list[Camera]) -> None:
    with pytest.raises(ValueError, match="cannot be drawn at once; allowed: 1 to 16"):
        stages.views_of(cameras)


@pytest.mark.parametrize("wrong", [target(0).float(), target(0)[:, 1:], target(0).flip(2).mT])
def test_targets_must_fit(wrong: Tensor) -> None:
    with pytest.raises(ValueError, match="uint8"):
        cuda.compare(Moment(splats(3)), camera(0.0), BACKGROUND, wrong, Measure(0.0))


def test_more_tiles_than_two_bytes_can_tell_apart() -> None:
    """1 x 32800 tiles, drawn as a column; the splats lie at its ends and in between."""
    few, height = splats(6), 32_800 * 16
    view = Camera(np.eye(4), 1e6, 1e6, 8.0, height / 2, 16, height)  # a pixel is a unit out there
    places = torch.tensor([20.0, 1e5, 262_144.0, 262_500.0, 5e5, height - 20.0])
    means = torch.stack([torch.zeros(6), places - height / 2, torch.full((6,), 1e6)], dim=1)
    few = replace(few, means=means, log_scales=torch.full((6, 3), math.log(2.0)))
    with torch.no_grad():
        frame = cuda.rasterize(Moment(few), view, torch.zeros(3))
    rows = places.long()
    squares = (rows + 0.5 - places) ** 2 + 0.5**2  # columns: of the pixel 8.5, of the splats 8
    expected = few.logit_opacities.sigmoid() * torch.exp(-0.5 * squares / (2.0**2 + DILATION))
    torch.testing.assert_close(frame.alpha[rows, 8], expected.detach(), rtol=0.01, atol=0)
    assert not frame.alpha[10_000:90_000].any()


def test_a_list_without_room_for_all_keeps_the_nearest(monkeypatch: pytest.MonkeyPatch) -> None:
    many, view = splats(60), stages.views_of([camera(0.4)])
    stored = stages.Stored(**many.detach().tensors(), axes=None)
    projected = stages.project(view, stored, 4)
    order = projected.keys.argsort(stable=True)
    ends = projected.counts[order].cumsum(0)
    kept = order[: len(order) // 2]
    monkeypatch.setattr(room.Room, "find", lambda *_: int(ends[len(kept) - 1]))
    bins = stages.bin_splats(view, projected, exact=False)
    assert int(bins.starts[-1]) == len(bins.entries)
    assert set(bins.entries[:, 0].tolist()) == set(kept[projected.counts[kept] > 0].tolist())


def test_entries_of_a_tile_lie_front_to_back_and_name_blocks() -> None:
    view = stages.views_of([camera(0.4), camera(1.4)])
    stored = stages.Stored(**splats(60).detach().tensors(), axes=None)
    projected = stages.project(view, stored, 4)
    bins = stages.bin_splats(view, projected, exact=True)
    starts = bins.starts.tolist()
    assert starts[0] == 0 and starts[-1] == int(projected.counts.sum()) == len(bins.entries)
    for tile, (start, end) in enumerate(pairwise(starts)):
        rows = bins.entries[start:end, 0].long()
        assert (projected.keys[rows].diff() >= 0).all()
        assert (rows // 60 == tile // view.tiles).all()
    bits = bins.entries[:, 1]
    assert ((bits > 0) & (bits < 256)).all()


@pytest.mark.parametrize("measure", [Measure(0.2), Measure(0.2, 0.3)])
@pytest.mark.parametrize("size", [(1, 1), (5, 40), (16, 16), (35, 22)])
def test_the_loss_is_that_of_its_twin(place: str, size: tuple[int, int], measure: Measure) -> None:
    width, height = size
    view = stages.views_of([camera(0.0, width, height)] * 2)
    rgb = torch.rand(2, 3, height, width, generator=generator())
    shape = 3, height, width
    targets = [torch.randint(256, shape, generator=generator(s), dtype=torch.uint8) for s in (1, 2)]
    there = [wanted.to(place) for wanted in targets]
    losses, gradient = (t.cpu() for t in stages.compare(view, rgb.to(place), there, measure))
    for i, wanted in enumerate(targets):
        exact = rgb[i].permute(1, 2, 0).double().requires_grad_()
        loss = photometric_loss_twin(exact, wanted, measure)
        loss.backward()
        assert exact.grad is not None
        assert_near(losses[i], loss.detach(), 1e-5)
        assert_near(gradient[i].permute(1, 2, 0), exact.grad)
