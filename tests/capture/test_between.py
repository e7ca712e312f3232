"""Frames between keyframes are placed by what the keyframes know."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import room
from hypothesis import given, settings
from hypothesis import strategies as st

from gsdmsr_cli.capture.between import RATIO, matched
from gsdmsr_cli.formats import read_scene

FRAMES, KEYFRAMES, FOREIGN = 29, 12, 17


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 20), st.integers(0, 20), st.integers(0, 1000))
def test_features_match_that_are_each_others_best_by_far(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    first = rng.integers(0, 256, (n, 128), np.uint8)
    noise = rng.integers(-40, 40, (m, 128))
    second = rng.integers(0, 256, (m, 128), np.uint8)
    twins = rng.random(m) < 0.5
    if n:
        near = first[rng.integers(0, n, m)] + noise
        second = np.where(twins[:, None], near.clip(0, 255), second).astype(np.uint8)
    expected = []
    if min(n, m) > 1:
        far = np.linalg.norm(first[:, None].astype(float) - second[None], axis=2)
        for i in range(n):
            j, second_best = far[i].argsort(kind="stable")[:2]
            if far[:, j].argmin() == i and far[i, j] < RATIO * far[i, second_best]:
                expected.append((i, j))
    assert list(zip(*(rows.tolist() for rows in matched(first, second)), strict=True)) == expected


def prepare(*arguments: object) -> None:
    line = [sys.executable, "-m", "gsdmsr_cli", "prepare", *map(str, arguments)]
    ended = subprocess.run(line, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr


@pytest.fixture(scope="module")
def shots() -> room.Shots:
    return room.film(room.walk(FRAMES))


@pytest.fixture(scope="module")
def pictures(shots: room.Shots, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Pictures of a walk, of which one shows something else, as sharp as the others."""
    folder = room.write_pictures(tmp_path_factory.mktemp("between") / "pictures", shots)
    foreign = np.rint(cv2.resize(room.pattern(7)[:240], (320, 240))).astype(np.uint8)
    cv2.imwrite(str(folder / f"shot{FOREIGN:03d}.png"), foreign)
    return folder


def test_every_frame_of_the_scene_has_a_camera(
    pictures: Path, shots: room.Shots, tmp_path: Path
) -> None:
    asked = "--keyframes", KEYFRAMES, "--keep-stages"
    prepare(pictures, "--out", tmp_path / "a", *asked)
    views = read_scene(tmp_path / "a").views
    kept = [i for i in range(FRAMES) if i != FOREIGN]
    assert [view.name for view in views] == [f"{i:05d}" for i in kept]
    assert [view.time for view in views] == pytest.approx([i / (FRAMES - 1) for i in kept])
    centres = np.stack([view.camera.centre for view in views])
    assert room.trajectory_error(centres, shots.poses[kept, :3, 3]) < 0.003
    quality = json.loads((tmp_path / "a" / "scene.json").read_text())["quality"]
    assert quality["frames"]["dropped"] == [f"shot{FOREIGN:03d}.png"]
    assert quality["frames"]["parts"] == [KEYFRAMES] and quality["fewest_points_in_a_frame"] > 100
    # the same again from stages up to the keyframes' cameras
    (placed,) = (tmp_path / "a.stages").glob("between-*")
    before = {path.name: path.read_bytes() for path in placed.iterdir()}
    placed.rename(tmp_path / "earlier")
    prepare(pictures, "--out", tmp_path / "a", "--overwrite", *asked)
    assert {path.name: path.read_bytes() for path in placed.iterdir()} == before
