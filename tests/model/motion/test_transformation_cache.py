"""The grid and network that say how splats go on, and when they stop to say it."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from kernel_checks import generator
from motion_checks import FACTS, moved_by, splats_of

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.layer import options_of
from gsdmsr_cli.model.motion.transformation_cache import Options, TransformationCache

COUNT = 12
SMALL = Options(levels=4, features=4, log2_rows=6, width=16)


def begun() -> TransformationCache:
    """At the second moment of two, at which the network adds the same to all splats."""
    cache = TransformationCache(SMALL, FACTS, COUNT, generator())
    cache.settle(splats_of(COUNT), first=True)
    cache.go_on(0.0, 0.0, 0.5, 1.0)
    cache.network[-1].bias.data.copy_(torch.tensor([0.1, 0.0, -0.2, 0, 0, 0, 0]))
    return cache


SHIFT = FACTS.bound * torch.tensor([0.1, 0.0, -0.2])


def test_what_the_network_says_is_added_once_and_stays() -> None:
    cache, splats = begun(), splats_of(COUNT)
    for _ in range(3):
        torch.testing.assert_close(moved_by(cache, splats, 0.5).means, splats.means + SHIFT)
        cache.settle(splats, first=False)
    torch.testing.assert_close(cache.offsets, (SHIFT / FACTS.bound).expand(COUNT, 3))


def test_a_moment_begins_with_the_motion_of_the_last() -> None:
    cache, splats = begun(), splats_of(COUNT)
    cache.settle(splats, first=False)
    cache.go_on(0.0, 0.5, 1.0, 1.0)
    torch.testing.assert_close(moved_by(cache, splats, 1.0).means, splats.means + 2 * SHIFT)
    torch.testing.assert_close(moved_by(cache, splats, 0.5).means, splats.means + SHIFT)


def test_turns_follow_one_another() -> None:
    """A quarter about x, and then one about y, is not what the other order gives."""
    cache, splats = begun(), splats_of(COUNT)
    half = 0.5**0.5
    cache.network[-1].bias.data.copy_(torch.tensor([0, 0, 0, half - 1, half, 0, 0]))
    cache.settle(splats, first=False)
    cache.go_on(0.0, 0.5, 1.0, 1.0)
    cache.network[-1].bias.data.copy_(torch.tensor([0, 0, 0, half - 1, 0, half, 0]))
    cache.settle(splats, first=False)
    found = cache.turns + torch.tensor([1.0, 0, 0, 0])
    torch.testing.assert_close(found, torch.tensor([0.5, 0.5, 0.5, -0.5]).expand(COUNT, 4))


def test_the_files_of_moments_need_neither_grid_nor_network() -> None:
    cache, splats = begun(), splats_of(COUNT)
    cache.settle(splats, first=False)
    kept = ("offsets", "turns", "past_offsets", "past_turns", "times")
    tensors = {name: cache.tensors()[name] for name in kept}
    again = TransformationCache(SMALL, FACTS, COUNT, generator(1))
    again.restore(tensors, COUNT)
    assert torch.equal(moved_by(again, splats, 0.5).means, moved_by(cache, splats, 0.5).means)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"levels": 0}, "motion.levels|levels"),
        ({"levels": 3, "features": 2}, "multiple of 16"),
        ({"resolutions": [16, 8]}, "the first 2 or more"),
        ({"log2_rows": 30}, "4 to 24"),
        ({"width": 20}, "multiple of 16"),
        ({"rate": [1e-3, 0.0]}, "both above 0"),
    ],
)
def test_bad_options_are_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(UsageError, match=message):
        options_of("gsdmsr_cli.model.motion", {"name": "transformation_cache", **options})
