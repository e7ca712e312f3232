"""What is baked shows what the model shows, whatever moves its splats."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from kernel_checks import generator
from layer_checks import started_layer
from motion_checks import FACTS, disturbed, splats_of, started
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground import plugins
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.geometry import covariance
from gsdmsr_cli.model import motion as motions
from gsdmsr_cli.model.layer import Layer
from gsdmsr_cli.model.model import FURTHER, MOTION, Model
from gsdmsr_cli.moving.baked import Baked
from gsdmsr_cli.moving.baking import bake
from gsdmsr_cli.moving.coding import coded, described, steps_named
from gsdmsr_cli.moving.container import from_bytes, to_bytes
from gsdmsr_cli.moving.decoding import decoded
from gsdmsr_cli.moving.parts import QUICKLY, Part, integers_of, packed
from gsdmsr_cli.moving.playing import model_of
from gsdmsr_cli.moving.shapes import rotations_and_scales, upright

COUNT = 40


def opaque(splats: Splats) -> Splats:
    return replace(splats, logit_opacities=splats.logit_opacities.abs() + 1)


def model_with(name: str, moving: int = COUNT, *layers: str, **options: Any) -> Model:
    """Return a model whose motion, and further layers, do something."""
    named: dict[str, Layer] = {MOTION: disturbed(started(name, moving, **options))}
    for layer in layers:
        named[FURTHER + layer] = disturbed(started_layer(layer, moving))
    return Model(opaque(splats_of(COUNT)), named, moving)


def shown(moment: Moment) -> dict[str, Tensor]:
    """Return what a moment looks like, whatever it says it by."""
    splats = moment.splats.detach()
    covariances = covariance(splats.quats, splats.log_scales)
    if moment.axes is not None:
        covariances = (moment.axes @ moment.axes.mT).detach()
    return {
        "means": splats.means,
        "shapes": covariances / covariances.norm(dim=(1, 2), keepdim=True),
        "sizes": covariances.norm(dim=(1, 2)).log(),
        "opacities": splats.logit_opacities.sigmoid(),
        "sh": splats.sh,
    }


def assert_looks_the_same(model: Model, other: Model, time: float, within: float = 2e-4) -> None:
    found, expected = (shown(m.at(m.instant(time))) for m in (other, model))
    for name, values in expected.items():
        apart = (found[name] - values).abs().max()
        assert apart < within, (name, time, float(apart))


@pytest.mark.parametrize("name", [n for n in plugins.names(motions.__name__)])
def test_every_motion_is_baked(name: str) -> None:
    model = model_with(name)
    played = model_of(bake(model, FACTS.frames))
    for place in (0, 7, FACTS.frames - 1):
        assert_looks_the_same(model, played, place / (FACTS.frames - 1))


@pytest.mark.parametrize("layer", ["temporal_opacity", "life_span", "drift"])
@pytest.mark.parametrize("name", ["control_points", "polynomial", "static"])
def test_layers_after_a_motion_are_baked(name: str, layer: str) -> None:
    model = model_with(name, COUNT, layer)
    baked = bake(model, FACTS.frames)
    for place in (0, 7, FACTS.frames - 1):
        assert_looks_the_same(model, model_of(baked), place / (FACTS.frames - 1))
    assert (baked.lives is None) == (layer == "drift")
    assert (baked.bodies is None) == (name != "control_points")


def test_lives_that_a_layer_knows_take_no_curves() -> None:
    for name in ("covariance_4d", "vibration"):
        baked = bake(model_with(name), FACTS.frames)
        assert baked.lives is not None
        strong = [n for n, t in baked.tracks.items() if t.shares.abs().max() > 1e-2]
        assert strong == ["splat/offset"], name


def test_splats_that_stand_still_have_no_curves() -> None:
    baked = bake(model_with("multiscale", 15), FACTS.frames)
    assert (baked.moving, len(baked.splats)) == (15, COUNT)
    assert all(len(track.shares) == 15 for track in baked.tracks.values())
    still = bake(model_with("static", 0), FACTS.frames)
    assert (still.moving, still.times, dict(still.tracks)) == (0, 1, {})
    assert_looks_the_same(model_with("static", 0), model_of(still), 0.4)


def test_a_motion_between_the_times_that_were_looked_at_is_near() -> None:
    model = model_with("control_points")
    played = model_of(bake(model, 200))
    for time in (0.1234, 0.5017):
        assert_looks_the_same(model, played, time, within=2e-2)


def test_splats_that_are_never_seen_are_left_out() -> None:
    splats = opaque(splats_of(COUNT))
    splats.logit_opacities[[3, 17, 35]] = -9.0
    model = Model(splats, {MOTION: disturbed(started("control_points", 30))}, 30)
    baked = bake(model, FACTS.frames)
    assert (len(baked.splats), baked.moving) == (COUNT - 3, 28)
    kept = [row for row in range(COUNT) if row not in (3, 17, 35)]
    expected = model.at(model.instant(0.0)).splats.means[kept].detach()
    played = model_of(baked)
    assert torch.allclose(played.at(played.instant(0.0)).splats.means, expected, atol=1e-4)


def test_values_that_are_not_finite_are_refused() -> None:
    splats = opaque(splats_of(COUNT))
    splats.sh[5] = float("nan")
    model = Model(splats, {MOTION: started("static", COUNT)})
    with pytest.raises(DataError, match="NaN"):
        bake(model, FACTS.frames)


def test_upright_quaternions_are_of_the_same_splats() -> None:
    quats = torch.randn(100, 4, generator=generator()).double()
    log_scales = torch.randn(100, 3, generator=generator(1)).double()
    found, turns = upright(quats)
    assert (found[:, 0] >= found.abs().amax(dim=1) - 1e-9).all()
    assert torch.allclose(covariance(found, log_scales), covariance(quats, log_scales))
    assert set(turns.abs().sum(dim=1).tolist()) == {1.0}


def test_axes_are_matched_to_those_before() -> None:
    """A splat whose axes turn slowly has rotations that change slowly, in any order of lengths."""
    splats = splats_of(30)
    previous = None
    for step in range(12):
        angle = torch.tensor(0.1 * step)
        turn = torch.tensor(
            [[angle.cos(), -angle.sin(), 0], [angle.sin(), angle.cos(), 0], [0, 0, 1]]
        )
        lengths = torch.diag(torch.tensor([1.0, 1 + 0.3 * (step - 6) / 6, 2.0]))
        axes = (turn @ lengths).expand(30, 3, 3)
        quats, log_scales = rotations_and_scales(Moment(splats, axes=axes), previous)
        assert torch.allclose(covariance(quats, log_scales), axes @ axes.mT, atol=1e-5)
        if previous is not None:
            assert ((quats * previous).sum(dim=1) > 0.99).all()
        previous = quats


def parts_of(baked: Baked, steps: dict[str, float]) -> list[Part]:
    return [packed(table) for table in coded(baked, steps, FACTS.bound)]


def coded_and_back(baked: Baked, factor: float) -> Baked:
    steps = {name: step * factor for name, step in steps_named(baked).items()}
    data = to_bytes(described(baked), parts_of(baked, steps))
    return decoded(*from_bytes(data))


@pytest.mark.parametrize("name", ["control_points", "multiscale", "covariance_4d", "rigid_groups"])
def test_what_is_coded_comes_back_as_fine_as_asked(name: str) -> None:
    model = model_with(name, 30)
    baked = bake(model, FACTS.frames)
    again = coded_and_back(baked, 2.0**-5)
    assert (again.moving, again.times, len(again.splats)) == (30, FACTS.frames, COUNT)
    # the order is another one: splats are matched by their places
    first, second = (m.at(m.instant(0.4)).splats for m in (model_of(baked), model_of(again)))
    nearest = torch.cdist(first.means, second.means).argmin(dim=1)
    assert sorted(nearest.tolist()) == list(range(COUNT))
    second = second.take(nearest)
    for attribute in ("means", "sh"):
        assert torch.allclose(getattr(first, attribute), getattr(second, attribute), atol=2e-2)
    opacities = first.logit_opacities.sigmoid(), second.logit_opacities.sigmoid()
    assert torch.allclose(*opacities, atol=2e-2)


@pytest.mark.parametrize("name", ["control_points", "multiscale", "covariance_4d", "rigid_groups"])
def test_parts_say_what_tables_do_however_they_are_packed(name: str) -> None:
    baked = bake(model_with(name, 30), FACTS.frames)
    for table in coded(baked, steps_named(baked), FACTS.bound):
        for part in (packed(table), packed(table, QUICKLY)):
            assert (part.name, part.least, part.step) == (table.name, table.least, table.step)
            assert (part.rows, part.columns) == (table.rows, table.columns)
            assert np.array_equal(integers_of(part), table.integers)


def test_coarse_steps_take_fewer_bytes() -> None:
    baked = bake(model_with("multiscale"), FACTS.frames)
    sizes = []
    for factor in (0.25, 1.0, 4.0):
        steps = {name: step * factor for name, step in steps_named(baked).items()}
        sizes.append(sum(len(part.stream) for part in parts_of(baked, steps)))
    assert sizes[0] > 1.2 * sizes[1] > 1.4 * sizes[2]


@pytest.mark.parametrize(
    "spoilt", [{"splats": 41}, {"moving": 99}, {"sh_degree": 2}, {"times": 3}, {"bodies": None}]
)
def test_parts_that_do_not_fit_are_refused(spoilt: dict[str, Any]) -> None:
    baked = bake(model_with("control_points"), FACTS.frames)
    header, parts = from_bytes(to_bytes(described(baked), parts_of(baked, steps_named(baked))))
    with pytest.raises((ValueError, KeyError)):
        decoded({**header, **spoilt}, parts)
