"""What every layer after the motion must keep to, over all files of the folder that have one.

Those that act on the canonical splats before the motion have tests of their own.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from functools import cache

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from kernel_checks import generator
from layer_checks import started_layer
from motion_checks import FACTS, disturbed, splats_of
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground import plugins
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model import layers
from gsdmsr_cli.model.building import start_model
from gsdmsr_cli.model.layer import Instant, Layer
from gsdmsr_cli.model.layers.newcomers import Newcomers
from gsdmsr_cli.training.rates import NAMED

COUNT = 7
TIMES = 0.0, 0.3, 1.0


def has_layer_after_the_motion(name: str) -> bool:
    """Tell whether a file of the folder has such a layer."""
    members = vars(plugins.load(layers.__name__, name)).values()
    classes = [one for one in members if isinstance(one, type) and issubclass(one, Layer)]
    return not any(one.before_motion for one in classes)


AFTER = list(filter(has_layer_after_the_motion, plugins.names(layers.__name__)))

every_layer = pytest.mark.parametrize("name", AFTER)


@cache
def learnt(name: str) -> Layer:
    """Return a layer that has been trained; to be copied by whoever resizes it."""
    return disturbed(started_layer(name, COUNT))


def moment_of(splats: Splats) -> Moment:
    """Return what a motion made of other splats, for layers that ask how they have turned."""
    return Moment(splats, canonical_quats=splats_of(len(splats), 1).quats)


def tensors_at(layer: Layer, moment: Moment, time: float) -> dict[str, Tensor]:
    """Return all tensors of what a layer makes of a moment."""
    after = layer.at(moment, Instant(time))
    further = {"axes": after.axes, "features": after.features}
    return after.splats.tensors() | {n: t for n, t in further.items() if t is not None}


def assert_close(found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    assert found.keys() == expected.keys()
    for name, tensor in expected.items():
        torch.testing.assert_close(found[name], tensor, atol=1e-6, rtol=1e-6, msg=name)


def test_the_known_layers_are_found() -> None:
    assert {"temporal_opacity", "decoder", "life_span", "drift"} <= set(AFTER)


@every_layer
def test_only_one_that_says_so_changes_splats_from_the_start(name: str) -> None:
    moment = moment_of(splats_of(COUNT))
    for progress in (0.0, 1.0):
        layer = started_layer(name, COUNT)
        layer.advance(progress)
        found = [tensors_at(layer, moment, time) for time in TIMES]
        own = moment.splats.tensors()
        same = all(torch.equal(after[what], own[what]) for after in found for what in own)
        assert same == layer.identity_at_start
    trained = [tensors_at(learnt(name), moment, time) for time in TIMES]
    pairs = zip(trained, found, strict=True)
    changed = any(not torch.equal(one[what], t) for one, t_at in pairs for what, t in t_at.items())
    # a layer may do nothing but shade what has been drawn, say where views are from, or wait for
    # the second moment of a stream
    assert changed or layer.shades or layer.holds_views or isinstance(layer, Newcomers)


@every_layer
@given(rows=st.lists(st.integers(0, COUNT - 1), max_size=20), time=st.floats(0, 1, width=32))
@settings(max_examples=15, deadline=None)
def test_resize_then_apply_is_apply_then_resize(name: str, rows: list[int], time: float) -> None:
    wanted = torch.tensor(rows, dtype=torch.long)
    moment, layer = moment_of(splats_of(COUNT)), copy.deepcopy(learnt(name))
    expected = {what: t[wanted] for what, t in tensors_at(layer, moment, time).items()}
    layer.take(wanted, torch.zeros_like(wanted, dtype=torch.bool))
    assert_close(tensors_at(layer, moment.take(wanted), time), expected)


@every_layer
def test_gradients_reach_all_that_is_trained_for_each_splat(name: str) -> None:
    splats = splats_of(COUNT).map(torch.nn.Parameter)
    layer, rng = disturbed(started_layer(name, COUNT)), generator(5)
    parts = []
    for time in TIMES:
        for tensor in tensors_at(layer, moment_of(splats), time).values():
            parts.append((tensor * torch.randn(tensor.shape, generator=rng)).sum())
    torch.stack(parts).sum().backward()
    for parameter in layer.parameters():
        if parameter.rate is not None and parameter.per_splat:
            gradient = parameter.tensor.grad
            assert gradient is not None and gradient.isfinite().all(), parameter.name
            assert gradient.any(), parameter.name
    for what, tensor in splats.tensors().items():
        assert tensor.grad is not None and tensor.grad.any(), what


@every_layer
def test_parameters_have_names_of_their_own_and_learning_rates(name: str) -> None:
    parameters = started_layer(name, COUNT).parameters()
    assert len({parameter.name for parameter in parameters}) == len(parameters)
    for parameter in parameters:
        own = isinstance(parameter.rate, tuple)
        assert parameter.rate is None or own or parameter.rate in NAMED, parameter.name
        assert not parameter.per_splat or len(parameter.tensor) == COUNT, parameter.name


@every_layer
def test_what_is_saved_comes_back_the_same(name: str) -> None:
    layer, moment = learnt(name), moment_of(splats_of(COUNT))
    loaded = started_layer(name, COUNT + 3)
    loaded.restore(layer.tensors(), COUNT)
    loaded.advance(1.0)
    for time in TIMES:
        expected = tensors_at(layer, moment, time)
        for what, tensor in tensors_at(loaded, moment, time).items():
            assert torch.equal(tensor, expected[what]), what


@every_layer
def test_a_penalty_is_a_finite_scalar_that_can_be_learnt_from(name: str) -> None:
    layer = disturbed(started_layer(name, COUNT))
    penalty = layer.penalty(Moment(splats_of(COUNT)), Instant(0.4), generator())
    if penalty is None:
        return
    assert penalty.shape == () and penalty.isfinite()
    penalty.backward()
    assert any(t.grad is not None and t.grad.any() for t in layer.tensors().values())


@every_layer
def test_an_unknown_option_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match="no_such_option"):
        started_layer(name, COUNT, no_such_option=3)


@every_layer
def test_it_is_given_the_times_at_which_splats_were_seen(name: str) -> None:
    """By whoever starts a model; layers without times of their own leave them."""
    times = torch.linspace(0, 1, COUNT)
    given = splats_of(COUNT), {"name": "polynomial"}, [{"name": name}], FACTS, generator()
    model = start_model(*given, times=times)
    centres = {what: t for what, t in model.tensors().items() if what.endswith(".centres")}
    assert "motion.centres" in centres
    for what, tensor in centres.items():
        assert torch.equal(tensor, times), what
