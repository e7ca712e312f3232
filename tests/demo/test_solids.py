"""Solids: where rays enter, against a walk along each ray through an inside test."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray

from gsdmsr_cli.demo.solids import Ball, Box, Capsule, Disc, Solid

Points = NDArray[np.float64]
STEP = 2e-3


def in_ball(p: Points) -> NDArray[np.bool_]:
    return np.linalg.norm(p, axis=0) < 0.3


def in_box(p: Points) -> NDArray[np.bool_]:
    return (abs(p[0]) < 0.3) & (abs(p[1]) < 0.2) & (abs(p[2]) < 0.4)


def in_capsule(p: Points) -> NDArray[np.bool_]:
    return np.hypot(np.hypot(p[0], p[1]), np.maximum(abs(p[2]) - 0.3, 0)) < 0.15


SOLIDS: list[tuple[Solid, Callable[[Points], NDArray[np.bool_]]]] = [
    (Ball(0.3), in_ball),
    (Box((0.3, 0.2, 0.4)), in_box),
    (Capsule(0.3, 0.15), in_capsule),
]


def rays(count: int) -> tuple[Points, Points]:
    """Origins on a sphere of radius 1, directions towards points near the origin."""
    generator = np.random.default_rng(5)
    origins = generator.normal(size=(3, count))
    origins /= np.linalg.norm(origins, axis=0)
    directions = generator.uniform(-0.4, 0.4, (3, count)) - origins
    return origins, directions / np.linalg.norm(directions, axis=0)


@pytest.mark.parametrize(("solid", "inside"), SOLIDS)
def test_rays_enter_where_a_walk_does(
    solid: Solid, inside: Callable[[Points], NDArray[np.bool_]]
) -> None:
    origins, directions = rays(400)
    found = solid.intersect(origins.astype(np.float32), directions.astype(np.float32))
    steps = np.arange(0, 2, STEP)
    walk = inside(origins[:, :, None] + directions[:, :, None] * steps)
    expected = np.where(walk.any(1), steps[walk.argmax(1)], np.inf)
    hit = np.isfinite(expected)
    assert 50 < hit.sum() < 350
    # a ray that only grazes may slip between two steps of the walk
    assert (np.isfinite(found) != hit).sum() <= 3
    both = hit & np.isfinite(found)
    assert np.all(found[both] <= expected[both] + 1e-5)
    assert np.all(found[both] >= expected[both] - STEP - 1e-5)


@pytest.mark.parametrize(("solid", "inside"), SOLIDS)
def test_normals_are_unit_and_point_outward(
    solid: Solid, inside: Callable[[Points], NDArray[np.bool_]]
) -> None:
    origins, directions = rays(400)
    distances = solid.intersect(origins.astype(np.float32), directions.astype(np.float32))
    hit = np.isfinite(distances)
    points = (origins + distances.clip(max=9) * directions)[:, hit]
    normals = solid.normals(points.astype(np.float32))
    np.testing.assert_allclose(np.linalg.norm(normals, axis=0), 1, atol=1e-3)
    assert np.all((normals * directions[:, hit]).sum(0) < 1e-3)
    assert not inside(points + 1e-3 * normals).any()
    assert inside(points - 1e-3 * normals).mean() > 0.99


@pytest.mark.parametrize("solid", [solid for solid, _ in SOLIDS])
def test_the_bounding_sphere_holds_the_solid(solid: Solid) -> None:
    origins, directions = rays(400)
    distances = solid.intersect(origins.astype(np.float32), directions.astype(np.float32))
    hit = np.isfinite(distances)
    points = origins[:, hit] + distances[hit] * directions[:, hit]
    assert np.linalg.norm(points, axis=0).max() <= solid.radius + 1e-5


@pytest.mark.parametrize("solid", [solid for solid, _ in SOLIDS])
def test_what_lies_behind_is_not_hit(solid: Solid) -> None:
    origins, directions = rays(100)
    away = -directions.astype(np.float32)
    assert np.isinf(solid.intersect(origins.astype(np.float32), away)).all()


def test_a_disc_is_hit_from_both_sides_within_its_radius() -> None:
    origins = np.float32([[0, 0.9, 1.1, 0, 0], [0, 0, 0, 0, 0], [2, 2, 2, -3, 2]])
    directions = np.float32([[0, 0, 0, 0, 1], [0, 0, 0, 0, 0], [-1, -1, -1, 1, 0]])
    found = Disc(1.0).intersect(origins, directions)
    assert found.tolist() == [2, 2, np.inf, 3, np.inf]


@pytest.mark.parametrize("solid", [*(solid for solid, _ in SOLIDS), Disc(1.0)])
def test_textures_have_more_than_one_colour_in_range(solid: Solid) -> None:
    origins, directions = rays(400)
    distances = solid.intersect(origins.astype(np.float32), directions.astype(np.float32))
    hit = np.isfinite(distances)
    colours = solid.colours((origins[:, hit] + distances[hit] * directions[:, hit]).astype("f4"))
    assert colours.shape == (3, hit.sum())
    assert colours.min() >= 0
    assert colours.max() <= 1
    assert len(np.unique(colours.T, axis=0)) >= 2
