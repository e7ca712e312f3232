"""Where the rays of pixels begin that are compared with the cameras, and what is written."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import room

from gsdmsr_cli.capture import motion
from gsdmsr_cli.capture.candidates import Candidate
from gsdmsr_cli.capture.frames import Frames
from gsdmsr_cli.capture.masks import NOTE, read_mask
from gsdmsr_cli.capture.reconstruction import Reconstruction
from gsdmsr_cli.scene.imaging import write_png
from gsdmsr_cli.scene.lens import Lens

WIDTH, HEIGHT = 96, 64


def film(folder: Path) -> tuple[Frames, Reconstruction]:
    """Four frames of a room in which nothing moves; the last one has no camera.

    The second is not compared with any other: those are two or four frames away.
    """
    shots = room.film(room.walk(30)[:4], WIDTH, HEIGHT)
    names = tuple(f"{i}.png" for i in range(4))
    for name, picture in zip(names, shots.pictures, strict=True):
        write_png(folder / name, picture)
    size = WIDTH, HEIGHT
    taken = tuple(Candidate("film.mp4", i, float(i)) for i in range(4))
    frames = Frames(folder, names, taken, False, True, size, size, None, ())
    focal = room.FOCAL * WIDTH
    lens = Lens(focal, focal, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT)
    poses, nothing = np.linalg.inv(shots.poses[:3]), np.zeros(0, np.int64)
    found = Reconstruction(
        lens, names[:3], poses, np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0), nothing,
        (nothing,) * 3, (names[:3],),
    )  # fmt: skip
    return frames, found


@pytest.mark.parametrize("longest", [motion.LONGEST, WIDTH // 2], ids=["as it is", "shrunk"])
def test_pixels_are_looked_at_from_their_centres_in_the_size_they_have(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, longest: int
) -> None:
    asked: list[tuple[Lens, np.ndarray]] = []
    rays_of = motion.rays_of

    def remember(lens: Lens, pixels: np.ndarray) -> np.ndarray:
        asked.append((lens, pixels))
        return rays_of(lens, pixels)

    monkeypatch.setattr(motion, "rays_of", remember)
    monkeypatch.setattr(motion, "LONGEST", longest)
    frames, found = film(tmp_path)
    told: list[tuple[int, int]] = []
    out = tmp_path / "masks"
    out.mkdir()
    given = out, frames, found, len(found.names)
    motion.write_found_masks(*given, lambda done, total: told.append((done, total)))
    ((lens, pixels),) = asked
    width, height = (WIDTH, HEIGHT) if longest > WIDTH else (WIDTH // 2, HEIGHT // 2)
    assert (lens.width, lens.height, lens.cx, lens.cy) == (width, height, width / 2, height / 2)
    assert lens.fx == lens.fy == pytest.approx(room.FOCAL * width)
    expected = [[x + 0.5, y + 0.5] for y in range(height) for x in range(width)]
    np.testing.assert_array_equal(pixels, expected)
    assert told == [(1, 3), (2, 3), (3, 3)]
    for name in frames.names:
        mask = read_mask(out / name)
        assert mask.shape == (HEIGHT, WIDTH) and not mask.any()
    assert json.loads((out / NOTE).read_text()) == {"missing": ["3.png"]}


def test_flow_between_two_frames_is_computed_once_and_then_forgotten(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    rng = np.random.default_rng(0)
    greys = [rng.integers(0, 255, (24, 32), dtype=np.uint8) for _ in range(9)]
    expected = {
        (i, j): motion.optical_flow(greys[i], greys[j])
        for i in range(9) for j in range(9) if abs(i - j) in (2, 4)
    }  # fmt: skip
    asked: list[tuple[np.ndarray, np.ndarray]] = []
    compute = motion.optical_flow
    monkeypatch.setattr(motion, "optical_flow", lambda *p: (asked.append(p), compute(*p))[1])
    flows = motion.Flows(greys)
    for i in range(9):
        for j in (i - 4, i - 2, i + 2, i + 4):
            if 0 <= j < 9:
                forward, back = flows.there_and_back(i, j)
                np.testing.assert_array_equal(forward, expected[i, j])
                np.testing.assert_array_equal(back, expected[j, i])
    assert len(asked) == len(expected)
    assert not flows._kept
