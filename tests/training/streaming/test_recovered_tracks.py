"""Splats on known paths are found again, moment after moment, from pictures of the reference."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from recovery_checks import OPTIONS, WHITE, Case, canonical_splats, moved, scene_of
from stream_checks import each_moment
from torch import Tensor

from gsdmsr_cli.options.preset import Preset, load_preset
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.training.streaming.trainer import StreamTrainer


def circling(means: Tensor, time: float) -> Tensor:
    """All on small circles, a third of a turn each."""
    angle = torch.tensor(2.1 * time)
    x, y = angle.sin(), 1 - angle.cos()
    return means + 0.35 * torch.stack([x, y, x * y])


def turning(means: Tensor, time: float) -> Tensor:
    """All as one rigid body about an axis, 40 degrees."""
    angle = torch.tensor(0.7 * time)
    c, s = angle.cos(), angle.sin()
    zero, one = torch.tensor(0.0), torch.tensor(1.0)
    rows = [torch.stack(row) for row in ((c, -s, zero), (s, c, zero), (zero, zero, one))]
    return means @ torch.stack(rows).mT


WAYS = {"persistent": ["motion.rate=[4e-3,1e-4]"], "hicom": ["motion.splats=[6,1]"]}
"""Presets that follow single splats, and options for so few."""


def preset_of(way: str) -> Preset:
    own = (
        "splats.start=box",
        "training.steps=1",
        "stream.steps=50",
        "stream.neighbours=3",
    )
    held = [option for option in OPTIONS if "average_from" not in option]
    return load_preset(way, None, [*held, "data.background=white", *own, *WAYS[way]])


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("path", [circling, turning], ids=lambda path: path.__name__)
def test_splats_are_followed_to_a_hundredth_of_their_paths(
    path: Callable[[Tensor, float], Tensor], tmp_path: Path, way: str
) -> None:
    case = Case({"name": "tracks"}, moved(path), between=False)
    scene, pictures = scene_of(case, tmp_path), Pictures(WHITE, 1, 1 << 24)
    trainer = StreamTrainer(scene, preset_of(way), best_engine("cpu"), pictures)
    with torch.no_grad():
        for name, tensor in canonical_splats().tensors().items():
            trainer.model.splats.tensors()[name].copy_(tensor)
    found, before = [], torch.get_num_threads()
    torch.set_num_threads(1)
    for _ in each_moment(trainer):
        found.append(trainer.model.at(trainer.model.instant(trainer.shot.time)).splats.means)
    torch.set_num_threads(before)
    true = torch.stack([path(canonical_splats().means, shot.time) for shot in trainer.shots])
    ways = (true[1:] - true[:-1]).norm(dim=2).sum(dim=0)
    errors = (torch.stack(found).detach() - true).norm(dim=2).mean(dim=0) / ways
    assert errors.median() < 0.01 and (errors < 0.02).all(), errors
