"""Control points spread over points: among few candidates nearly as well as among all of them."""

from __future__ import annotations

import pytest
import torch
from kernel_checks import generator
from motion_checks import are_among
from scipy.spatial import cKDTree
from torch import Tensor

from gsdmsr_cli.ops import spread as spreading
from gsdmsr_cli.ops.spread import CANDIDATES, spread_out


def clouds() -> dict[str, Tensor]:
    """Points in a volume, on a surface, in clumps and along a line, with one far away."""
    rng, count = generator(), 30_000
    normal = torch.randn(count, 3, generator=rng)
    clumps = torch.randn(20, 1, 3, generator=rng).expand(-1, count // 20, -1).reshape(-1, 3)
    line = torch.rand(count, 1, generator=rng) * torch.tensor([[1.0, 2.0, 0.5]])
    line[7] = 50.0
    return {
        "box": torch.rand(count, 3, generator=rng),
        "sphere": torch.nn.functional.normalize(normal),
        "clumps": clumps + 0.05 * normal,
        "line": line,
    }


def cover(points: Tensor, chosen: Tensor) -> tuple[float, float]:
    """Return the largest distance to the nearest control point, and the least between two."""
    tree = cKDTree(chosen)
    return tree.query(points)[0].max(), tree.query(chosen, k=2)[0][:, 1].min()


@pytest.mark.parametrize("name", ["box", "sphere", "clumps"])
@pytest.mark.parametrize("count", [100, 400])
def test_few_candidates_cover_nearly_as_well_as_all_points(
    name: str, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    points = clouds()[name]
    assert CANDIDATES * count < len(points)
    reach, apart = cover(points, spread_out(points, count))
    monkeypatch.setattr(spreading, "CANDIDATES", len(points))
    best, spaced = cover(points, spread_out(points, count))
    assert reach <= 1.15 * best
    assert apart >= 0.85 * spaced


@pytest.mark.parametrize("least", [1, 50, 1000, 10_000])
def test_candidates_are_as_many_as_wanted_and_one_of_each_cell(least: int) -> None:
    for points in clouds().values():
        rows = spreading._candidates(points, least)
        assert least <= len(rows) < 2 * least
        assert len(set(rows.tolist())) == len(rows)


def test_points_of_one_place_are_candidates_where_others_are_too_few() -> None:
    points = torch.tensor([[0.0, 0.0, 0.0], [1.0, 2.0, 3.0]]).repeat(50, 1)
    assert spreading._candidates(points, 10).sort().values.tolist() == list(range(100))


def test_candidates_lie_on_their_device_and_are_the_same_there(place: str) -> None:
    points = clouds()["sphere"]
    found = spreading._candidates(points.to(place), 500)
    assert found.device.type == place
    assert torch.equal(found.cpu(), spreading._candidates(points, 500))
    assert torch.equal(spread_out(points.to(place), 9), spread_out(points, 9))


def test_points_spread_from_end_to_end() -> None:
    points = torch.zeros(101, 3)
    points[:, 1] = torch.linspace(0, 1, 101)
    chosen = spread_out(points[torch.randperm(101, generator=generator())], 5)
    ends = chosen[:, 1].sort().values
    assert ends[0] == 0 and ends[-1] == 1
    assert float(ends.diff().min()) > 0.1


@pytest.mark.parametrize("size", [1, 2, 7])
def test_fewer_points_than_wanted_are_taken_repeatedly(size: int) -> None:
    points = torch.randn(size, 3, generator=generator())
    chosen = spread_out(points, 8)
    assert len(chosen) == 8
    assert are_among(points, chosen) and are_among(chosen, points)


def test_points_at_one_place_are_spread() -> None:
    assert spread_out(torch.ones(40, 3), 5).tolist() == [[1.0, 1.0, 1.0]] * 5


def test_points_of_more_weight_lie_nearer_to_each_other() -> None:
    """On a line one half of which weighs 4: there points are a quarter as far apart."""
    points = torch.zeros(4001, 3)
    points[:, 0] = torch.linspace(-1, 1, 4001)
    weights = torch.where(points[:, 0] < 0, 4.0, 1.0)
    chosen = spread_out(points, 41, weights)[:, 0].sort().values
    gaps = chosen.diff()
    near, far = gaps[chosen[1:] < 0], gaps[chosen[:-1] >= 0]
    assert float(near.mean() / far.mean()) == pytest.approx(0.25, abs=0.05)
    even = spread_out(points, 41, torch.full_like(weights, 4.0))
    assert torch.equal(even, spread_out(points, 41))
