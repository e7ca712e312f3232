"""Clocks that are off or drift show in when things move; those that agree are left in peace."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import room
from videos import TICKS, write_video

from gsdmsr_cli.capture.agreement import Film, clock_doubts
from gsdmsr_cli.capture.frames import read_frames
from gsdmsr_cli.capture.rig import write_rig
from gsdmsr_cli.capture.source import find_source

CAMERAS, RATE = 5, 30.0


def happens(times: np.ndarray, seed: int = 0) -> np.ndarray:
    """How much goes on in a scene at some times: bursts of 0.15 s at random moments."""
    rng = np.random.default_rng(seed)
    moments, heights = rng.uniform(-5, 70, 120), rng.uniform(0.3, 1, 120)
    bursts = heights * np.exp(-0.5 * ((times[:, None] - moments) / 0.15) ** 2)
    return 0.1 + bursts.sum(axis=1)


def films_of(
    seconds: float, ahead: float = 0.0, drift: float = 0.0, alike: bool = True
) -> list[Film]:
    """Cameras that see one thing each in its own way; the third's clock is off."""
    rng = np.random.default_rng(1)
    films = []
    for camera in range(CAMERAS):
        times = np.arange(round(seconds * RATE)) / RATE
        true = (times[1:] + times[:-1]) / 2
        if camera == 2:
            true = true - ahead - drift * true / seconds
        seen = happens(true, 0 if alike else camera) ** rng.uniform(0.7, 1.4) * rng.uniform(0.2, 5)
        films.append(Film(f"c{camera}.mp4", times, seen * rng.uniform(0.9, 1.1, len(seen))))
    return films


@pytest.mark.parametrize("ahead", [0.4, -0.25, 1.3])
def test_a_clock_that_is_off_is_named_with_its_offset(ahead: float) -> None:
    (told,) = clock_doubts(films_of(20, ahead))
    assert told.startswith("the clock of c2.mp4 seems to be ")
    match = re.search(r"--offset c2=(-?[\d.]+) ", told)
    assert match is not None and float(match[1]) == pytest.approx(ahead, abs=0.04)


def test_a_clock_that_drifts_is_named() -> None:
    (told,) = clock_doubts(films_of(60, ahead=-0.6, drift=1.2))
    found = re.search(r"c2.mp4 seems to drift: .* it is (\S+) s ahead .* half and (\S+) s", told)
    assert found is not None
    first, second = map(float, found.groups())
    assert first == pytest.approx(-0.3, abs=0.1) and second == pytest.approx(0.3, abs=0.1)


@pytest.mark.parametrize("seconds", [0.1, 2, 20])
def test_clocks_that_agree_or_tell_nothing_are_left_in_peace(seconds: float) -> None:
    assert clock_doubts(films_of(seconds)) == []
    assert clock_doubts(films_of(seconds, ahead=0.02)) == []
    assert clock_doubts(films_of(seconds, alike=False)) == []
    still = [Film(f.file, f.times, np.zeros_like(f.changes)) for f in films_of(seconds)]
    assert clock_doubts(still) == []


def test_what_happens_again_and_again_tells_no_offset() -> None:
    times = np.arange(600) / RATE
    swings = [1 + np.sin(2 * np.pi * (times[1:] - 0.3 * (i == 2))) for i in range(CAMERAS)]
    assert clock_doubts([Film(f"c{i}", times, s) for i, s in enumerate(swings)]) == []


def test_a_rig_names_a_clock_that_is_off_until_its_offset_is_given(tmp_path: Path) -> None:
    """Videos of 12 s in which the light flickers at random, 0.4 s later for the second camera."""
    levels = np.random.default_rng(0).integers(0, 60, 130)
    (tmp_path / "rig").mkdir()
    for camera, pose in enumerate(room.walk(3, reach=0.5)):
        late = 4 * (camera == 1)
        still = room.draw(pose, 96, 64)[0] // 2
        film = [still + np.uint8(levels[i + 8 - late]) for i in range(120)]
        ticks = [i * TICKS // 10 for i in range(120)]
        write_video(tmp_path / "rig" / f"c{camera}.mp4", film, ticks=ticks, options={"crf": "12"})
    source = find_source(tmp_path / "rig", "rig")
    for name, offsets in (("off", {}), ("right", {"c1": 0.4})):
        (tmp_path / name).mkdir()
        write_rig(tmp_path / name, source, 12, 1600, offsets, lambda done, total: None)
    (told,) = read_frames(tmp_path / "off").doubts
    assert "the clock of c1.mp4 seems to be +0.40 s ahead" in told
    assert read_frames(tmp_path / "right").doubts == ()
