"""What is said of the quality of cameras, on a walk small enough to work out by hand."""

from __future__ import annotations

import copy
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from datasets import write_picture

from gsdmsr_cli.capture.candidates import Candidate
from gsdmsr_cli.capture.frames import Frames
from gsdmsr_cli.capture.masks import NOTE
from gsdmsr_cli.capture.quality import assess, parallaxes, warnings
from gsdmsr_cli.capture.reconstruction import Reconstruction
from gsdmsr_cli.scene.lens import Lens

WIDTH, HEIGHT, FOCAL = 60, 100, 80.0
POINTS = np.array([[0.0, 0.0, 4.0], [1.0, 0.0, 2.0], [0.0, 3.0, 10.0], [0.5, 0.0, 4.0]])


def reconstruction(count: int = 3) -> Reconstruction:
    """Cameras at x = 0, 1, 2 that look along z, and four points, one of which nobody sees."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, 0, 3] = -np.arange(count)
    lens = Lens(FOCAL, 70.0, 28.0, 52.0, WIDTH, HEIGHT, (0.1,))
    seen = (np.array([0, 1]), np.array([0]), np.array([0, 1, 2]))[:count]
    names = tuple(f"{i:03d}.png" for i in range(count))
    return Reconstruction(
        lens, names, poses, POINTS, np.zeros((4, 3), np.uint8), np.array([0.4, 0.8, 0.5, 0.1]),
        np.array([3, 2, 1, 1]), seen, (names, ("x", "y")),
    )  # fmt: skip


def frames(of_pictures: bool = False) -> Frames:
    """The frames of those cameras, and a fourth without one; of a film of 60 x 100 px."""
    taken = tuple(Candidate(f"film{i}.mp4", 10 * i, float(i)) for i in range(4))
    names = tuple(f"{i:03d}.png" for i in range(4))
    size = WIDTH, HEIGHT
    return Frames(
        Path(), names, taken, of_pictures, True, size, size, 75.0, ("b",) * 2, CUTS, 3,
        (("film1.mp4", "PQ"),),
    )  # fmt: skip


CUTS = (("film0.mp4", 1.5),)


def test_the_report_of_a_walk() -> None:
    report = assess(frames(), reconstruction(), 0.02, 0.3, "nothing", None)
    assert report["frames"] == {
        "chosen": 4, "registered": 3, "dropped": ["film3.mp4 frame 30"], "parts": [3, 2],
        "left_out_as_blurred": 2, "left_out_as_plain": 3,
        "cuts": [{"file": "film0.mp4", "seconds": 1.5}],
        "high_range": [{"file": "film1.mp4", "kind": "PQ"}],
    }  # fmt: skip
    assert report["reprojection_px"] == pytest.approx((3 * 0.4 + 2 * 0.8 + 0.5 + 0.1) / 7)
    assert report["track_length"] == 7 / 4 and report["points"] == 4
    assert report["fewest_points_in_a_frame"] == 1
    angle = 2 * math.degrees(math.atan(50 / FOCAL))  # of the longer side, which is upright
    assert report["focal"] == {
        "px": FOCAL, "field_of_view_deg": pytest.approx(angle), "noted_px": 75.0,
    }  # fmt: skip
    assert report["diagonal_px"] == pytest.approx(math.hypot(60, 100))
    # the farthest cameras are 2 apart; depths are 4 2, 4, 4 2 10
    assert report["path_over_depth"] == pytest.approx(2 / 4)
    assert report["parallax_deg"] == pytest.approx(np.median(parallaxes(reconstruction())))
    x, y = (WIDTH - 28.0) / FOCAL, (HEIGHT - 52.0) / 70.0
    bent = 0.1 * (x * x + y * y)
    assert report["corner_distortion_px"] == pytest.approx(bent * math.hypot(32, 48))
    assert report["masks"] == {
        "from": "nothing", "covered": 0.0, "most_covered": 0.0, "frames_without": [],
    }  # fmt: skip
    assert (report["moving_matches"], report["turning_matches"]) == (0.02, 0.3)
    json.dumps(report, allow_nan=False)


def test_pictures_are_dropped_by_their_names() -> None:
    report = assess(frames(of_pictures=True), reconstruction(), 0.0, 0.0, "nothing", None)
    assert report["frames"]["dropped"] == ["film3.mp4"]


def test_parallax_is_the_largest_angle_that_a_point_is_seen_under() -> None:
    """Of cameras at x = 0, 1, 2; what one camera sees, or none, has no parallax."""
    expected = [
        math.degrees(math.atan(2 / 4)),  # from x = 0 straight ahead and from x = 2
        math.degrees(2 * math.atan(1 / 2)),  # half way between the first and the last
        0.0,
        0.0,
    ]
    np.testing.assert_allclose(parallaxes(reconstruction()), expected, atol=1e-5)


def test_parallax_takes_a_camera_half_way_into_account() -> None:
    """One that is off to the side, while the first and the last are at one place."""
    found = reconstruction()
    poses = found.poses.copy()
    poses[1, :3, 3], poses[2, :3, 3] = [0, -3.0, 0], 0
    assert parallaxes(replace(found, poses=poses))[0] == pytest.approx(
        math.degrees(math.atan(3 / 4))
    )


def test_a_point_at_a_camera_has_a_parallax_too() -> None:
    points = np.concatenate([POINTS[:1] * 0, POINTS[1:]])
    assert np.isfinite(parallaxes(replace(reconstruction(), points=points))).all()


def test_masks_are_told_by_what_they_cover(tmp_path: Path) -> None:
    for i in range(4):
        mask = np.zeros((10, 20, 1), np.uint8)
        mask[:, : 5 * i] = 255
        write_picture(tmp_path / f"{i:03d}.png", mask)
    (tmp_path / NOTE).write_text(json.dumps({"missing": ["001.png"]}))
    report = assess(frames(), reconstruction(), 0.0, 0.0, "given", tmp_path)
    assert report["masks"] == {
        "from": "given", "covered": pytest.approx(0.375), "most_covered": 0.75,
        "frames_without": ["001.png"],
    }  # fmt: skip


SOUND: dict[str, Any] = {
    "frames": {
        "chosen": 100,
        "registered": 95,
        "dropped": ["x"] * 5,
        "left_out_as_blurred": 0,
        "left_out_as_plain": 0,
        "high_range": [],
        "cuts": [],
    },
    "reprojection_px": 1.0,
    "track_length": 3.5,
    "fewest_points_in_a_frame": 100,
    "focal": {"px": 115.0, "field_of_view_deg": 110.0, "noted_px": 100.0},
    "corner_distortion_px": 30.0,
    "diagonal_px": 1000.0,
    "parallax_deg": 3.0,
    "moving_matches": 0.1,
    "turning_matches": 0.8,
    "masks": {"frames_without": [], "covered": 0.6},
}
"""A report in which everything is as doubtful as it may be without a warning."""

DOUBTFUL = {
    "frames without a camera": ("frames.registered", 94, "5 of 100 frames have no camera"),
    "blurred": ("frames.left_out_as_blurred", 1, "1 frames are far less sharp"),
    "black": ("frames.left_out_as_plain", 2, "2 pictures are black or of one colour"),
    "HDR": ("frames.high_range", [{"file": "a.mp4", "kind": "HLG"}], "a.mp4 is HDR (HLG): its"),
    "cut": ("frames.cuts", [{"file": "a.mp4", "seconds": 3.2}], "cut (a.mp4 at 3.20 s)"),
    "off": ("reprojection_px", 1.01, "1.01 px off where they should be seen, more than 1:"),
    "moving": ("moving_matches", 0.11, "11 % of what was found in two frames moves"),
    "turning": ("turning_matches", 0.81, "that only turns explains 81 %"),
    "bent": ("corner_distortion_px", 31.0, "bends the corner by 31 px"),
    "flat": ("parallax_deg", 2.9, "only 2.9 degrees apart"),
    "short tracks": ("track_length", 3.4, "in only 3.4 frames on average"),
    "few points": ("fewest_points_in_a_frame", 99, "sees only 99 of the points"),
    "a mask missing": ("masks.frames_without", ["7.png"], "1 frames have no mask, such as 7.png"),
    "masks too large": ("masks.covered", 0.61, "masks cover 61 % of the pictures"),
    "wide": ("focal.field_of_view_deg", 111.0, "comes out as 111 degrees"),
    "narrow": ("focal.field_of_view_deg", 24.0, "comes out as 24 degrees"),
    "long": ("focal.px", 116.0, "comes out as 116 px, but the camera has noted 100"),
    "short": ("focal.px", 86.0, "comes out as 86 px, but the camera has noted 100"),
}


def changed(place: str, value: object) -> dict[str, Any]:
    report = copy.deepcopy(SOUND)
    *parts, key = place.split(".")
    inner = report[parts[0]] if parts else report
    inner[key] = value
    return report


@pytest.mark.parametrize(("place", "value", "message"), DOUBTFUL.values(), ids=DOUBTFUL)
def test_a_doubt_beyond_its_limit_is_told_alone(place: str, value: object, message: str) -> None:
    (warning,) = warnings(changed(place, value))
    assert message in warning


@pytest.mark.parametrize(
    ("place", "value"),
    [("focal.field_of_view_deg", 25.0), ("focal.px", 87.0), ("focal.noted_px", None)],
)
def test_what_is_within_all_limits_is_not_doubted(place: str, value: object) -> None:
    assert warnings(SOUND) == []
    assert warnings(changed(place, value)) == []


@pytest.mark.parametrize(("length", "doubted"), [(2.4, True), (2.5, False)])
def test_few_frames_need_no_long_tracks(length: float, doubted: bool) -> None:
    """Of five frames half are enough."""
    report = changed("track_length", length)
    report["frames"] |= {"chosen": 5, "registered": 5}
    assert bool(warnings(report)) == doubted
