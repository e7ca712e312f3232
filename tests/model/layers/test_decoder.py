"""Colours decoded from features: the closed form, its ends, training it in all ways."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from layer_checks import started_layer
from motion_checks import FACTS, disturbed, splats_of
from seam_checks import assert_trains_the_same_in_all_ways
from torch import Tensor

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.model import layers
from gsdmsr_cli.model.layer import Instant, Layer, options_of
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.raster import best_engine, load_engine
from gsdmsr_cli.scene.camera import Camera, look_at

COUNT, HEIGHT, WIDTH = 40, 24, 33


def camera() -> Camera:
    pose = look_at(np.array([3.0, -2.0, 1.0]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return Camera(pose, 30.0, 33.0, 15.0, 13.0, WIDTH, HEIGHT)


def drawn(layer: Layer, engine: str = "reference") -> Frame:
    moment = layer.at(Moment(splats_of(COUNT)), Instant(0.8))
    chosen = load_engine("reference") if engine == "reference" else best_engine(engine)
    return chosen.rasterize(moment, camera(), torch.ones(3))


def test_it_is_its_formula() -> None:
    """Per pixel, from the line through its centre; nothing is added where nothing is."""
    layer = disturbed(started_layer("decoder", COUNT))
    frame, eye = drawn(layer), camera()
    frame = replace(frame, alpha=frame.alpha * (torch.arange(WIDTH) > 10))
    shaded = layer.shade(frame, Instant(0.8, eye)).rgb.detach()
    first, bias, last, last_bias = (
        t.detach().double().numpy() for n, t in layer.tensors().items() if n.startswith("network.")
    )
    rgb, alpha, features = (
        t.detach().double().numpy() for t in (frame.rgb, frame.alpha, frame.features)
    )
    for row, column in ((0, 0), (12, 20), (23, 32), (7, 11)):
        spot = np.array([(column + 0.5 - 15) / 30, (row + 0.5 - 13) / 33, 1.0])
        line = eye.rotation.T @ spot
        line /= np.linalg.norm(line)
        at = row, column
        x = np.concatenate([rgb[at], features[at], [alpha[at]], eye.centre / FACTS.bound, line])
        added = np.maximum(x @ first + bias, 0) @ last + last_bias
        expected = rgb[at] + alpha[at] * added
        np.testing.assert_allclose(shaded[at].numpy(), expected, rtol=1e-4, atol=1e-5)
    assert torch.equal(shaded[:, :11], frame.rgb[:, :11])
    assert not torch.allclose(shaded[:, 11:], frame.rgb[:, 11:])


def test_features_are_those_of_direction_and_those_of_time_about_the_centres() -> None:
    layer, splats = started_layer("decoder", COUNT), splats_of(COUNT)
    features = layer.at(Moment(splats), Instant(0.3)).features
    assert features is not None and not features[:, 3:].any()
    torch.testing.assert_close(features[:, :3], 0.5 + SH_C0 * splats.sh[:, 0])
    layer = disturbed(layer)
    own = layer.tensors()
    for time in (0.0, 0.3):
        features = layer.at(Moment(splats), Instant(time)).features
        expected = torch.cat(
            [own["directions"], (time - own["centres"])[:, None] * own["times"]], dim=1
        )
        torch.testing.assert_close(features, expected)


def test_at_the_start_colours_are_those_that_were_drawn() -> None:
    layer = started_layer("decoder", COUNT)
    frame = drawn(layer)
    assert torch.equal(layer.shade(frame, Instant(0.8, camera())).rgb, frame.rgb)


def test_a_frame_without_features_stays_and_one_without_a_camera_is_refused() -> None:
    """Before the motion begins splats are drawn as they are stored."""
    layer = disturbed(started_layer("decoder", COUNT))
    frame = drawn(layer)
    bare = replace(frame, features=None)
    assert layer.shade(bare, Instant(0.8, camera())) is bare
    with pytest.raises(ValueError, match="need a camera"):
        layer.shade(frame, Instant(0.8))


def test_the_engine_of_the_cpu_shows_what_the_reference_shows() -> None:
    """Colours, and gradients by the features and the network."""
    found = []
    for engine in ("reference", "cpu"):
        layer = disturbed(started_layer("decoder", COUNT))
        shaded = layer.shade(drawn(layer, engine), Instant(0.8, camera())).rgb
        weights = torch.linspace(0, 1, shaded.numel()).view(shaded.shape)
        (shaded * weights).sum().backward()
        gradients = [t.grad for t in layer.tensors().values() if t.requires_grad]
        found.append([shaded.detach(), *gradients])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=2e-3, atol=2e-4)


def test_its_gradients_are_right() -> None:
    layer = disturbed(started_layer("decoder", 5))
    for parameter in layer.parameters():
        parameter.set_values(parameter.tensor.double())
    given = torch.Generator().manual_seed(3)
    rgb, alpha, features = (
        torch.rand(HEIGHT, WIDTH, *n, dtype=torch.float64, generator=given)[:3, :4]
        for n in ((3,), (), (6,))
    )
    eye = replace(camera(), width=4, height=3)

    def shaded(rgb: Tensor, alpha: Tensor, features: Tensor) -> Tensor:
        frame = Frame(rgb, alpha, None, torch.zeros(0), torch.zeros(0, 2), features)
        return layer.shade(frame, Instant(0.8, eye)).rgb

    inputs = [t.clone().requires_grad_() for t in (rgb, alpha, features)]
    assert torch.autograd.gradcheck(shaded, inputs)


def test_it_trains_with_workers_without_and_resumed(tiny_scene: Path, tmp_path: Path) -> None:
    options = "motion={name: polynomial}", "layers=[{name: temporal_opacity}, {name: decoder}]"
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, *options)
    tensors = trainer.model.tensors()
    for name in ("directions", "times", "network.0.weight", "network.1.weight"):
        assert tensors[f"layers.decoder.{name}"].any(), name
    assert trainer.model.shades and isinstance(trainer.model, Model)


@pytest.mark.parametrize(
    ("option", "value", "allowed"),
    [("width", 24, "16 or 32"), ("rate", [0, 1], r"\[start, end\], both above 0")],
)
def test_options_out_of_range_are_refused(option: str, value: object, allowed: str) -> None:
    with pytest.raises(UsageError, match=f"^layers: {option} is .*; allowed: {allowed}$"):
        options_of(layers.__name__, {"name": "decoder", option: value})
