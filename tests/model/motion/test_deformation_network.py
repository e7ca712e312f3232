"""The network of Deformable-3DGS: its formula in float64, its gradients, and the noise of time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from motion_checks import FACTS, disturbed, model_of, moved_by, splats_of, started
from seam_checks import assert_trains_the_same_in_all_ways
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.model.building import load_model
from gsdmsr_cli.model.layer import Instant, Layer
from gsdmsr_cli.model.motion._encoded_network import encode
from gsdmsr_cli.model.motion.deformation_network import deform

NAME = "deformation_network"
SMALL = {"width": 16, "depth": 3, "position_octaves": 2, "time_octaves": 1}


def gamma(values: np.ndarray, octaves: int) -> np.ndarray:
    """Return [p, sin(2^l p), cos(2^l p)] of (N, D), the frequencies of a coordinate together."""
    waves = [
        [wave(2.0**octave * column) for column in values.T for octave in range(octaves)]
        for wave in (np.sin, np.cos)
    ]
    return np.stack([*values.T, *waves[0], *waves[1]], axis=1)


def outputs_of(motion: Layer, means: Tensor, time: float, depth: int) -> np.ndarray:
    """Return what the network makes of positions (N, 3), by the paper's equation, in float64."""
    options = motion.options  # type: ignore[attr-defined]
    where = gamma(means.double().numpy() / FACTS.bound, options.position_octaves)
    when = gamma(np.full((len(means), 1), time), options.time_octaves)
    inputs = np.concatenate([where, when], axis=1)
    tensors = {name: t.detach().double().numpy() for name, t in motion.tensors().items()}
    columns = tensors["network.0.weight"].shape[0]
    inputs = np.pad(inputs, ((0, 0), (0, columns - inputs.shape[1])))
    x = inputs
    for layer in range(depth):
        x = x @ tensors[f"network.{layer}.weight"] + tensors[f"network.{layer}.bias"]
        x = np.maximum(x, 0)
        if layer == depth // 2:
            x = np.concatenate([inputs, x], axis=1)
    return x @ tensors[f"network.{depth}.weight"] + tensors[f"network.{depth}.bias"]


def test_an_encoding_is_its_formula() -> None:
    values = splats_of(9).means
    for octaves in (0, 1, 10):
        found = encode(values.double(), octaves).numpy()
        np.testing.assert_allclose(found, gamma(values.double().numpy(), octaves), atol=1e-12)


@pytest.mark.parametrize("depth", [2, 3, 8])
def test_it_is_its_formula(depth: int) -> None:
    """x + dx, q / |q| + dq as a rotation, exp(log s) + ds."""
    splats, time = splats_of(40), 0.3
    motion = disturbed(started(NAME, 40, depth=depth, time_octaves=4))
    expected = outputs_of(motion, splats.means, time, depth)
    assert np.abs(expected).max() > 0.1
    found = moved_by(motion, splats, time).map(lambda t: t.detach().double())
    stored = splats.map(Tensor.double)
    np.testing.assert_allclose(found.means - stored.means, expected[:, :3], atol=2e-4)
    turned = torch.nn.functional.normalize(stored.quats, dim=1).numpy() + expected[:, 3:7]
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    units = torch.nn.functional.normalize(found.quats, dim=1).numpy()
    np.testing.assert_allclose(units, turned, atol=2e-4)
    scales = np.abs(stored.log_scales.exp().numpy() + expected[:, 7:])
    kept = scales > 0.01 * stored.log_scales.exp().numpy()
    np.testing.assert_allclose(found.log_scales.exp().numpy()[kept], scales[kept], atol=2e-4)


def test_a_scale_stays_above_zero_and_gradients_stay_finite() -> None:
    splats = splats_of(3)
    splats.log_scales[0], splats.log_scales[1] = -200.0, 0.0
    leaves = splats.map(torch.nn.Parameter)
    offsets = torch.zeros(3, 10)
    offsets[1, 7:] = -1.0  # of a scale of 1: nothing is left
    offsets.requires_grad_()
    moved = deform(leaves, offsets)
    assert moved.log_scales.isfinite().all()
    torch.testing.assert_close(moved.log_scales[1].exp(), torch.full((3,), 1e-3))
    moved.log_scales.sum().backward()
    assert offsets.grad is not None and offsets.grad.isfinite().all()
    assert leaves.log_scales.grad is not None and leaves.log_scales.grad.isfinite().all()


def test_gradients_in_float64() -> None:
    motion = disturbed(started(NAME, 5, **SMALL))
    splats = splats_of(5)
    trained = [parameter for parameter in motion.parameters()]
    for parameter in trained:
        parameter.set_values(parameter.tensor.double())
    quats, log_scales = splats.quats.double(), splats.log_scales.double() + 3

    def moved(quats: Tensor, log_scales: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:
        given = Splats(splats.means.double(), quats, log_scales, splats.logit_opacities, splats.sh)
        found = moved_by(motion, given, 0.37)
        return found.means, found.quats, found.log_scales

    inputs = quats.requires_grad_(), log_scales.requires_grad_(), *(p.tensor for p in trained)
    assert torch.autograd.gradcheck(moved, inputs, fast_mode=True)


def test_the_field_gets_no_gradient_for_where_it_is_read() -> None:
    splats = splats_of(7).map(torch.nn.Parameter)
    moved_by(disturbed(started(NAME, 7)), splats, 0.3).means.sum().backward()
    assert torch.equal(splats.means.grad, torch.ones_like(splats.means))


def test_the_noise_of_time_falls_and_ends() -> None:
    """t + 0.1 / 20 frames * (1 - 0.25 / 0.5) * jitter at a quarter; none in a finished model."""
    splats, motion = splats_of(7), disturbed(started(NAME, 7))
    shown = {}
    for progress in (0.25, 0.5, 1.0):
        motion.advance(progress)
        shown[progress] = motion.at(Moment(splats), Instant(0.3, None, 2.0)).splats.means
    plain = moved_by(motion, splats, 0.3).means
    assert torch.equal(shown[0.5], plain) and torch.equal(shown[1.0], plain)
    expected = moved_by(motion, splats, 0.3 + 0.1 / 20 * 0.5 * 2.0).means
    assert not torch.equal(expected, plain) and torch.equal(shown[0.25], expected)
    quiet = started(NAME, 7, noise=0.0)
    quiet.advance(0.0)
    assert quiet.noise == 0.0  # type: ignore[attr-defined]


def test_it_trains_with_workers_without_and_resumed(tiny_scene: Path, tmp_path: Path) -> None:
    options = f"motion={{name: {NAME}, width: 32, depth: 3}}", "optimizer.network=[0.01,0.001]"
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, *options)
    assert trainer.model.needs_jitter


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"width": 24}, "width is 24; allowed: a multiple of 16, 16 or more"),
        ({"depth": 1}, "depth is 1; allowed: 2 to 16"),
        ({"depth": 17}, "depth is 17; allowed: 2 to 16"),
        ({"position_octaves": 17}, "position_octaves is 17; allowed: 0 to 16"),
        ({"time_octaves": -1}, "time_octaves is -1; allowed: 0 to 16"),
        ({"noise": -0.1}, "noise is -0.1; allowed: 0 or more"),
        ({"noise_until": 1.5}, "noise_until is 1.5; allowed: a progress from 0 to 1"),
    ],
    ids=str,
)
def test_options_out_of_range_are_refused_in_one_line(
    options: dict[str, float], message: str
) -> None:
    with pytest.raises(UsageError, match=f"{message}$") as caught:
        started(NAME, 1, **options)
    assert "\n" not in str(caught.value)


def test_a_file_of_another_depth_is_refused() -> None:
    model = model_of(splats_of(3), disturbed(started(NAME, 3, depth=4)))
    for depth in (3, 5):
        with pytest.raises(DataError, match=r"a network of shapes|nothing for 'network\.5"):
            load_model(model.tensors(), {"name": NAME, "depth": depth}, (), FACTS, 1.0)
