"""Smooth camera paths: exactly through every key, smooth, and with the scene in the picture."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline
from scipy.spatial.transform import Rotation, Slerp

from gsdmsr_cli.paths import _quaternions
from gsdmsr_cli.paths._smooth import Key, hermite, interpolate, lengths, turned
from gsdmsr_cli.scene.camera import Camera, look_at

SEEDS = st.integers(0, 2**31)


def facing(where: list[float], target: list[float] | None = None, **lens: float) -> Camera:
    pose = look_at(np.array(where), np.array(target or [0.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0]))
    sizes = {"fx": 50.0, "fy": 50.0, "cx": 20.0, "cy": 15.0} | lens
    return Camera(pose, **sizes, width=40, height=30)


KEYS = [
    Key(facing([4, 0, 1]), 0.2),
    Key(facing([0.5, 4, 1]), 0.9),
    Key(facing([-3, 0.2, 2], fx=70.0, fy=70.0, cx=25.0), 0.4),
    Key(facing([0, -5, 0.5], [0.2, 0.1, 0.3]), 0.5),
]
KNOTS = np.array([0.0, 1.0, 2.5, 3.0])


def rotations_of(seed: int, count: int) -> np.ndarray:
    return Rotation.random(count, random_state=seed).as_matrix()


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_a_quaternion_is_that_of_the_rotation(seed: int) -> None:
    rotation = Rotation.random(random_state=seed)
    expected = rotation.as_quat(scalar_first=True)
    found = _quaternions.quaternion(rotation.as_matrix())
    np.testing.assert_allclose(found, expected * np.sign(expected[0]), atol=1e-12)


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0.0, -0.8]])
@pytest.mark.parametrize("angle", [0.0, np.pi, 1e-9, np.pi - 1e-9])
def test_a_quaternion_of_no_turn_and_of_half_a_turn(axis: list[float], angle: float) -> None:
    matrix = Rotation.from_rotvec(angle * np.array(axis)).as_matrix()
    found = Rotation.from_quat(_quaternions.quaternion(matrix), scalar_first=True)
    np.testing.assert_allclose(found.as_matrix(), matrix, atol=1e-12)


@given(SEEDS)
@settings(max_examples=50, deadline=None)
def test_products_exponentials_and_logarithms_are_those_of_rotations(seed: int) -> None:
    one, two = Rotation.random(4, random_state=seed), Rotation.random(4, random_state=seed + 1)
    a, b = one.as_quat(scalar_first=True), two.as_quat(scalar_first=True)
    product = Rotation.from_quat(_quaternions.multiply(a, b), scalar_first=True)
    np.testing.assert_allclose(product.as_matrix(), (one * two).as_matrix(), atol=1e-12)
    vectors = _quaternions.logarithm(a)
    np.testing.assert_allclose(vectors, one.as_rotvec(), atol=1e-9)
    back = Rotation.from_quat(_quaternions.exponential(vectors), scalar_first=True)
    np.testing.assert_allclose(back.as_matrix(), one.as_matrix(), atol=1e-12)


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_between_two_rotations_the_way_is_slerp(seed: int) -> None:
    pair = rotations_of(seed, 2)
    at = np.linspace(1.0, 3.0, 9)
    found = turned(np.array([1.0, 3.0]), pair, at)
    expected = Slerp([1.0, 3.0], Rotation.from_matrix(pair))(at).as_matrix()
    np.testing.assert_allclose(found, expected, atol=1e-9)


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_rotations_turn_evenly_where_the_keys_do(seed: int) -> None:
    """A constant speed of turning is reproduced, through keys at uneven distances."""
    rng = np.random.default_rng(seed)
    axis, start = rng.normal(size=3), Rotation.random(random_state=seed)
    speed = axis / np.linalg.norm(axis) * 0.9  # at most 2.7 rad between keys: the shorter way
    knots = np.cumsum(rng.uniform(0.5, 3.0, 5))
    at = np.linspace(knots[0], knots[-1], 23)
    turn = [start * Rotation.from_rotvec(speed * t) for t in [*knots, *at]]
    matrices = np.stack([rotation.as_matrix() for rotation in turn])
    np.testing.assert_allclose(turned(knots, matrices[:5], at), matrices[5:], atol=1e-9)


def test_rotations_have_no_kink_at_a_key() -> None:
    rotations = np.stack([key.camera.rotation for key in KEYS])
    step = 1e-4
    for knot in KNOTS[1:-1]:
        at = knot + np.array([-step, 0, step])
        before, here, after = Rotation.from_matrix(turned(KNOTS, rotations, at))
        arriving = (before.inv() * here).as_rotvec() / step
        leaving = (here.inv() * after).as_rotvec() / step
        assert np.linalg.norm(leaving) > 0.1
        np.testing.assert_allclose(arriving, leaving, atol=5e-3 * np.linalg.norm(leaving))


@given(SEEDS)
@settings(max_examples=30, deadline=None)
def test_the_spline_is_exact_for_parabolas(seed: int) -> None:
    rng = np.random.default_rng(seed)
    knots = np.cumsum(rng.uniform(0.1, 2.0, 6))
    a, b, c = rng.normal(size=(3, 1, 3))
    at = np.linspace(knots[0], knots[-1], 31)
    values = a + b * knots[:, None] + c * knots[:, None] ** 2
    expected = a + b * at[:, None] + c * at[:, None] ** 2
    np.testing.assert_allclose(hermite(knots, values, at), expected, atol=1e-9)


def test_the_spline_is_the_cubic_hermite_spline_of_its_slopes() -> None:
    rng = np.random.default_rng(3)
    knots, values = np.cumsum(rng.uniform(0.3, 2, 5)), rng.normal(size=(5, 2))
    parabolas = [np.polyfit(knots[i : i + 3], values[i : i + 3], 2) for i in (0, 0, 1, 2, 2)]
    slopes = [2 * p[0] * knot + p[1] for p, knot in zip(parabolas, knots, strict=True)]
    at = np.linspace(knots[0], knots[-1], 40)
    expected = CubicHermiteSpline(knots, values, np.array(slopes))(at)
    np.testing.assert_allclose(hermite(knots, values, at), expected, atol=1e-9)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_the_path_leads_exactly_through_every_key(count: int) -> None:
    keys, knots = KEYS[-count:], KNOTS[:count]
    for key, shot in zip(keys, interpolate(keys, knots, knots), strict=True):
        np.testing.assert_allclose(
            shot.camera.world_to_camera, key.camera.world_to_camera, atol=1e-9
        )
        for name in ("fx", "fy", "cx", "cy", "width", "height"):
            assert getattr(shot.camera, name) == pytest.approx(getattr(key.camera, name)), name
        assert shot.time == pytest.approx(key.time)


def test_what_all_keys_look_at_stays_in_the_middle() -> None:
    keys = KEYS[:3]
    for shot in interpolate(keys, KNOTS[:3], np.linspace(0, 2.5, 40)):
        x, y, z = shot.camera.translation  # where the origin is seen from
        assert abs(x) < 1e-9 and abs(y) < 1e-9
        assert 3 < z < 5


def test_cameras_that_look_away_from_the_origin_are_joined_by_a_spline_of_their_centres() -> None:
    away = [Key(facing([x, 4, 0.5 * x * x], [x, 9, 0.5 * x * x]), 0.0) for x in (0, 1, 3)]
    shots = interpolate(away, np.array([0.0, 1.0, 3.0]), np.linspace(0, 3, 13))
    for i, shot in enumerate(shots):
        x = i / 4
        np.testing.assert_allclose(shot.camera.centre, [x, 4, 0.5 * x * x], atol=1e-9)


def test_keys_of_other_sizes_keep_their_field_of_view() -> None:
    small = facing([4, 0, 1])
    large = facing([0, 4, 1], fx=50.0, fy=50.0).resized(400, 300)
    shot = interpolate([Key(small, 0), Key(large, 0)], np.array([0.0, 1.0]), np.array([1.0]))[0]
    assert (shot.camera.width, shot.camera.fx) == (40, pytest.approx(50.0))


def test_lengths_count_way_turn_and_time() -> None:
    here = facing([4, 0, 0])
    quarter = facing([0, 4, 0])
    keys = [Key(here, 0.0), Key(here, 0.5), Key(here, 0.5), Key(quarter, 0.5)]
    waiting, nothing, going = lengths(keys)
    assert waiting == pytest.approx(0.5)
    assert 0 < nothing < 0.01  # but knots must ascend
    assert going == pytest.approx(np.sqrt(2) + np.pi / 2)
