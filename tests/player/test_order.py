"""Splats are sorted by where they are now: the order flips with time and camera."""

from __future__ import annotations

import json
from pathlib import Path

import files_by_hand as by_hand
import numpy as np
import pytest
from chromium import Chromium
from files_by_hand import File
from test_canvas import BLACK, CAMERAS, drawn_by_page, drawn_by_reference, psnr, show

from gsdmsr_cli.player.page import _module
from gsdmsr_cli.scene.camera import Camera, look_at

RED, GREEN = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)
FRONT, BACK = (
    Camera(look_at(np.array([0.0, y, 0.0]), np.zeros(3), np.array([0.0, 0.0, 1.0])),
           80.0, 80.0, 32.0, 32.0, 64, 64)
    for y in (-3.0, 3.0)
)  # fmt: skip


def luma(colour: tuple[float, ...]) -> list[float]:
    """Return Y, Co, Cg of degree 0 of a colour."""
    red, green, blue = ((value - 0.5) / 0.28209479177387814 for value in colour)
    middle = (red + blue) / 2
    return [(middle + green) / 2, (red - blue) / 2, (green - middle) / 2]


def swapping(by_bodies: bool) -> File:
    """Return two opaque splats, red and green, that swap their depths, seen along y."""
    way = np.array([[0.5, -0.5]]).T * [[0.0, 1.0, 0.0]]
    tables = {
        "means": -way, "quats": np.zeros((2, 3)), "log_scales": np.full((2, 3), np.log(0.3)),
        "opacities": np.ones((2, 1)), "sh_0": np.array([luma(RED), luma(GREEN)]),
    }  # fmt: skip
    kind = "body" if by_bodies else "splat"
    tables[f"curves/{kind}/offset"] = np.array([[0.0], [2.0]])
    tables[f"shares/{kind}/offset"] = way
    file = File(tables, moving=2, times=2)
    if by_bodies:
        file.bodies = {"count": 2, "neighbours": 0}
        tables |= {"points": -way, "body": np.array([[0], [1]])}
    return file


@pytest.mark.parametrize("by_bodies", [False, True])
def test_what_is_in_front_flips_with_time_and_camera(
    browser: Chromium, tmp_path: Path, by_bodies: bool
) -> None:
    file = swapping(by_bodies)
    show(browser, file, tmp_path)
    for time in (0.0, 1.0, 0.2):
        for camera in (FRONT, BACK):
            found = drawn_by_page(browser, camera, time, BLACK)
            (expected,) = drawn_by_reference(file, camera, time, BLACK)
            assert psnr(found, expected) >= 52
            red, green, _ = found[32, 32].astype(int)
            assert abs(red - green) > 200 and (red > green) == ((time < 0.5) == (camera is FRONT))


def test_the_order_comes_by_itself_while_it_plays(browser: Chromium, tmp_path: Path) -> None:
    """The page does not wait for an order, but gets it soon after."""
    show(browser, swapping(False), tmp_path)
    drawn_by_page(browser, FRONT, 0.0, BLACK)
    counted = browser.evaluate(
        """(async () => {
        const before = dsplat.statistics().orders;
        dsplat.setTime(0.9);
        for (let i = 0; i < 200 && dsplat.statistics().orders === before; i++) {
          await new Promise((done) => setTimeout(done, 20));
        }
        return [before, dsplat.statistics().orders];
        })()"""
    )
    assert counted[1] == counted[0] + 1
    browser.evaluate("dsplat.setTime(0.9), new Promise((done) => setTimeout(done, 300))")
    assert browser.evaluate("dsplat.statistics().orders") == counted[1]  # it is there already


def test_the_sort_and_the_bodies_that_are_followed_are_exact(browser: Chromium) -> None:
    rng = np.random.default_rng(0)
    depths = np.concatenate([rng.normal(size=3000) * 10.0 ** rng.integers(-6, 6, 3000), [0.0]])
    depths = np.concatenate([depths, depths[:50]]).astype(np.float32)
    points, queries = rng.normal(size=(60, 3)), rng.normal(size=(500, 3)) * 2
    given = {"depths": depths.tolist(), "points": points.ravel().tolist(),
             "queries": queries.ravel().tolist()}  # fmt: skip
    order, near = json.loads(
        browser.evaluate(
            f"""(() => {{
            {_module("moving")}
            {_module("sort")}
            const {{ depths, points, queries }} = {json.dumps(given)};
            const sorter = new Sorter(depths.length);
            sorter.depths.set(depths);
            const order = new Uint32Array(depths.length);
            sorter.sort(order);
            const near = nearest(Float32Array.from(queries), 500, Float32Array.from(points), 8);
            return JSON.stringify([[...order], [...near]]);
            }})()"""
        )
    )
    nearest_first = np.argsort(depths, kind="stable")
    assert order[::-1] == [int(i) for i in nearest_first]
    squares = ((queries[:, None] - points) ** 2).sum(axis=2)
    pairs = np.array(near).reshape(500, 8, 2)
    assert (pairs[..., 0] == np.argsort(squares, axis=1)[:, :8]).all()
    np.testing.assert_allclose(pairs[..., 1], np.sort(squares, axis=1)[:, :8], rtol=1e-4)


def test_many_splats_are_sorted_as_they_are_drawn(browser: Chromium, tmp_path: Path) -> None:
    """Opaque and close together, so that another order is another picture."""
    file = by_hand.with_bodies(24, 8, degree=0)
    file.tables["opacities"][:] = 1.0
    show(browser, file, tmp_path)
    for camera in CAMERAS:
        (expected,) = drawn_by_reference(file, camera, 0.8, BLACK)
        assert psnr(drawn_by_page(browser, camera, 0.8, BLACK), expected) >= 52
