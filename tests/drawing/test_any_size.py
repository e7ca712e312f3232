"""Pictures of other sizes than those of training, against those of training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from gsdmsr_cli.drawing.any_size import AnySize, at_any_size, focal_of
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import quat_to_rotmat
from gsdmsr_cli.raster import load_engine
from gsdmsr_cli.scene.camera import Camera

ENGINE = load_engine("reference")
SIZE = 48
WHITE = torch.ones(3, dtype=torch.float64)


def camera(size: int = SIZE) -> Camera:
    pose = np.eye(4)
    pose[2, 3] = 4.0
    return Camera(pose, 1.5 * size, 1.5 * size, size / 2, size / 2, size, size)


def thin(count: int = 24, seed: int = 0) -> Splats:
    """Return splats many of which are thinner than a pixel of a picture of 48 x 48."""
    rng = torch.Generator().manual_seed(seed)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng, dtype=torch.float64)

    return Splats(
        means=0.5 * random(count, 3),
        quats=random(count, 4),
        log_scales=random(count, 3) - 4,
        logit_opacities=1 + random(count),
        sh=random(count, 1, 3),
    )


def drawn(engine: object, moment: Moment, size: int) -> Tensor:
    rgb: Tensor = engine.rasterize(moment, camera(size), WHITE).rgb  # type: ignore[attr-defined]
    return rgb


def blocks(picture: Tensor, times: int) -> Tensor:
    size = len(picture) // times
    return picture.reshape(size, times, size, times, 3).mean(dim=(1, 3))


TRAINED = AnySize(ENGINE, focal_of(camera()), focal_of(camera()))


@pytest.mark.parametrize("size", [SIZE, 56, 42])
def test_sizes_near_those_of_training_are_the_engines_own(size: int) -> None:
    moment = Moment(thin())
    assert torch.equal(drawn(TRAINED, moment, size), drawn(ENGINE, moment, size))


@pytest.mark.parametrize("times", [2, 3, 4])
def test_smaller_pictures_are_means_of_those_of_training(times: int) -> None:
    moment = Moment(thin())
    expected = blocks(drawn(ENGINE, moment, SIZE), times)
    torch.testing.assert_close(drawn(TRAINED, moment, SIZE // times), expected)
    plain = drawn(ENGINE, moment, SIZE // times)
    assert (plain - expected).abs().mean() > 0.01, "the engine alone draws another picture"


def test_a_size_that_does_not_divide_is_drawn_finer_than_in_training() -> None:
    moment = Moment(thin())
    expected = blocks(drawn(ENGINE, moment, 60), 2)
    torch.testing.assert_close(drawn(TRAINED, moment, 30), expected)


@pytest.mark.parametrize("axes", [False, True])
def test_a_splat_is_as_large_and_as_opaque_in_larger_pictures(axes: bool) -> None:
    """On the optical axis, where isotropic splats stay so: the centres of its pixels agree."""
    one = replace(
        thin(1), means=torch.zeros(1, 3).double(), log_scales=torch.full((1, 3), -4.0).double()
    )
    moment = Moment(one)
    if axes:
        matrices = quat_to_rotmat(one.quats) @ torch.diag_embed(one.log_scales.exp())
        moment = Moment(one, axes=matrices)
    small, large = drawn(ENGINE, moment, SIZE), drawn(TRAINED, moment, 3 * SIZE)
    torch.testing.assert_close(large[1::3, 1::3], small, rtol=0, atol=1e-6)
    plain = drawn(ENGINE, moment, 3 * SIZE)
    assert (plain[1::3, 1::3] - small).abs().max() > 0.1, "the engine alone draws it smaller"


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_larger_pictures_look_like_those_of_training(seed: int) -> None:
    moment = Moment(thin(seed=seed))
    small = drawn(ENGINE, moment, SIZE)
    error, plain = (
        float((drawn(engine, moment, 3 * SIZE)[1::3, 1::3] - small).abs().mean())
        for engine in (TRAINED, ENGINE)
    )
    assert error < 0.02 * plain


def test_what_else_a_frame_holds_is_that_of_its_size() -> None:
    splats = thin()
    moment = Moment(splats, features=splats.means)
    small = TRAINED.rasterize(moment, camera(SIZE // 2), WHITE, None, True)
    own = ENGINE.rasterize(moment, camera(SIZE // 2), WHITE, None, True)
    assert small.alpha.shape == own.alpha.shape and small.features is not None
    assert small.depth is not None and small.features.shape == (SIZE // 2, SIZE // 2, 3)
    torch.testing.assert_close(small.means2d, own.means2d)
    assert ((small.radii > 0) == (own.radii > 0)).all()
    large = TRAINED.rasterize(moment, camera(2 * SIZE), WHITE, None, True)
    assert large.depth is not None and large.alpha.shape == (2 * SIZE, 2 * SIZE)


def test_splats_that_are_not_finite_or_behind_are_drawn_by_neither() -> None:
    splats = thin(3)
    splats.means[0] = torch.nan
    splats.means[1] = torch.tensor([0.0, 0.0, -9.0])
    splats.log_scales[2, 0] = torch.inf
    for moment in (Moment(splats), Moment(splats, axes=torch.full((3, 3, 3), torch.nan))):
        assert torch.equal(
            drawn(TRAINED, moment, 2 * SIZE), torch.ones(2 * SIZE, 2 * SIZE, 3).double()
        )


def test_sizes_between_those_of_training_are_the_engines_own() -> None:
    moment = Moment(thin())
    both = at_any_size(ENGINE, [focal_of(camera(SIZE)), focal_of(camera(2 * SIZE))])
    for size in (SIZE, 64, 2 * SIZE):
        assert torch.equal(drawn(both, moment, size), drawn(ENGINE, moment, size))
    assert at_any_size(ENGINE, []) is ENGINE
