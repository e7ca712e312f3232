"""The Fourier series of splats: its formula in float64, its gradients, what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from motion_checks import FACTS, disturbed, model_of, moved_by, splats_of, started
from seam_checks import assert_trains_the_same_in_all_ways
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.model.building import load_model


@pytest.mark.parametrize("octaves", [1, 2, 5])
@pytest.mark.parametrize("time", [0.0, 0.37, 1.0])
def test_it_is_its_formula(octaves: int, time: float) -> None:
    splats, motion = splats_of(9), disturbed(started("fourier", 9, octaves=octaves))
    waves, turns = (t.detach().double().numpy() for t in motion.tensors().values())
    means = splats.means.double().numpy().copy()
    for i in range(octaves):
        phase = 2**i * np.pi * time
        means += waves[:, 2 * i] * np.sin(phase) + waves[:, 2 * i + 1] * np.cos(phase)
    found = moved_by(motion, splats, time)
    np.testing.assert_allclose(found.means.detach(), means, atol=1e-6)
    quats = splats.quats.double().numpy() + time * turns
    np.testing.assert_allclose(found.quats.detach(), quats, atol=1e-6)
    for name in ("log_scales", "logit_opacities", "sh"):
        assert found.tensors()[name] is splats.tensors()[name], name


def test_gradients_in_float64() -> None:
    splats, motion = splats_of(4), disturbed(started("fourier", 4))
    for parameter in motion.parameters():
        parameter.set_values(parameter.tensor.double())

    def moved(means: Tensor, quats: Tensor, *_: Tensor) -> tuple[Tensor, Tensor]:
        given = Splats(means, quats, splats.log_scales, splats.logit_opacities, splats.sh)
        found = moved_by(motion, given, 0.37)
        return found.means, found.quats

    stored = (t.double().requires_grad_() for t in (splats.means, splats.quats))
    assert torch.autograd.gradcheck(moved, (*stored, *motion.tensors().values()))


def test_it_trains_with_workers_without_and_resumed(tiny_scene: Path, tmp_path: Path) -> None:
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, "motion={name: fourier}")
    waves = trainer.model.tensors()["motion.waves"]
    assert waves.shape == (200, 4, 3) and waves.any(), "it has grown, and moves"


@pytest.mark.parametrize("octaves", [0, -1, 9])
def test_a_number_of_octaves_out_of_range_is_refused_in_one_line(octaves: int) -> None:
    with pytest.raises(UsageError, match=f"octaves is {octaves}; allowed: 1 to 8$") as caught:
        started("fourier", 1, octaves=octaves)
    assert "\n" not in str(caught.value)


def test_a_file_of_another_number_of_octaves_or_another_shape_is_refused() -> None:
    tensors = model_of(splats_of(3), disturbed(started("fourier", 3))).tensors()
    for name, shape in (("waves", (3, 8, 3)), ("waves", (3, 3, 3)), ("turns", (3, 3))):
        changed = tensors | {f"motion.{name}": torch.zeros(shape)}
        with pytest.raises(DataError, match=rf"the checkpoint holds shape .* for '{name}', not"):
            load_model(changed, {"name": "fourier"}, (), FACTS, 1.0)
