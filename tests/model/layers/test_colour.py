"""Colours come from a field over contracted space, by a splat's canonical centre alone."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from kernel_checks import generator
from motion_checks import FACTS, disturbed, moved_by, splats_of, started
from seam_checks import assert_trains_the_same_in_all_ways
from training_checks import preset_of, trainer_of

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.layer import options_of
from gsdmsr_cli.model.layers import colour
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.ops import hash_grid
from gsdmsr_cli.ops.hash_grid import lookup_twin

SMALL = colour.Options(levels=8, resolutions=(4, 32), log2_rows=8, width=16)


def bare(count: int) -> Splats:
    splats = splats_of(count)
    return replace(splats, sh=splats.sh[:, :1])


def field_of(count: int) -> colour.Colour:
    layer = colour.start(SMALL, FACTS, bare(count), generator())
    with torch.no_grad():
        for tensor in layer.tensors().values():
            tensor += 0.3 * torch.randn(tensor.shape, generator=generator(1))
    return layer


def test_it_begins_grey() -> None:
    layer = colour.start(SMALL, FACTS, bare(5), generator())
    found = moved_by(layer, bare(5), 0.3)
    assert torch.equal(found.sh, torch.zeros(5, 1, 3))
    assert torch.equal(found.means, bare(5).means)


def test_colours_are_the_network_of_the_grid_at_contracted_places() -> None:
    """In float64; some splats lie far outside of the box."""
    splats, layer = bare(20), field_of(20)
    splats.means[::2] *= 7
    lower, upper = (torch.tensor(corner).double() for corner in FACTS.box)
    places = 2 * (splats.means.double() - lower) / (upper - lower) - 1
    radii = places.norm(dim=1, keepdim=True)
    assert (radii > 2).any() and (radii < 1).any()
    outside = (2 - 1 / radii) * places / radii
    contracted = torch.where(radii > 1, outside, places) / 2
    levels = hash_grid.new_levels([4] * 3, [32] * 3, 8, 8)
    x = lookup_twin(levels, layer.table.detach().double(), contracted)
    for i, (weight, bias) in enumerate(layer.network):
        x = (x.relu() if i else x) @ weight.detach().double() + bias.detach().double()
    found = moved_by(layer, splats, 0.3).sh
    torch.testing.assert_close(found[:, 0].double(), x, rtol=1e-3, atol=1e-4)
    assert x.abs().max() > 0.1


def test_gradients_reach_the_field_and_not_positions() -> None:
    splats, layer = bare(20).map(torch.nn.Parameter), field_of(20)
    moved_by(layer, splats, 0.3).sh.square().sum().backward()
    assert splats.means.grad is None and splats.sh.grad is None
    assert all(t.grad is not None and t.grad.any() for t in layer.tensors().values())


def test_colours_stay_while_splats_move() -> None:
    splats, motion = bare(9), disturbed(started("hexplane"))
    model = Model(splats, {"motion": motion, "layers.colour": field_of(9)})
    one, two = (model.at(model.instant(time)).splats for time in (0.0, 1.0))
    assert torch.equal(one.sh, two.sh) and one.sh.any()
    assert not torch.equal(one.means, two.means)


def test_it_trains_with_workers_without_and_resumed(tiny_scene: Path, tmp_path: Path) -> None:
    small = "levels: 8, resolutions: [4, 32], log2_rows: 8, width: 16"
    layers = f"layers=[{{name: colour, {small}}}]"
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, layers, "splats.sh_degree=0")
    assert trainer.model.tensors()["layers.colour.network.2.bias"].any()


def test_harmonics_of_a_higher_degree_are_refused(tiny_scene: Path) -> None:
    with pytest.raises(UsageError, match=r"splats.sh_degree is 1; set it to 0$"):
        trainer_of(tiny_scene, preset_of("layers=[{name: colour}]", "splats.sh_degree=1"))


@pytest.mark.parametrize(
    ("option", "value", "allowed"),
    [
        ("levels", 33, "1 to 32"),
        ("levels", 7, "times features a multiple of 16"),
        ("features", 0, "1 to 8"),
        ("resolutions", [1, 8], r"\[first, last\], the first 2 or more"),
        ("log2_rows", 3, "4 to 24"),
        ("width", 24, "a multiple of 16, 16 or more"),
        ("rate", [1, 0], r"\[start, end\], both above 0"),
    ],
)
def test_bad_options_are_refused(option: str, value: object, allowed: str) -> None:
    with pytest.raises(UsageError, match=f"layers: {option} is .*; allowed: {allowed}$"):
        options_of("gsdmsr_cli.model.layers", {"name": "colour", option: value})


def test_a_table_of_another_size_is_told() -> None:
    layer = field_of(3)
    tensors = {name: t.detach() for name, t in layer.tensors().items()}
    tensors["table"] = torch.zeros(5, 2)
    with pytest.raises(ValueError, match=r"a table of shape \(5, 2\), not .*, for a hash grid"):
        layer.restore(tensors, 3)
