"""The large capture that reading is measured on, written small."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from gsdmsr_cli.benchmark.reading import SIZE, measure, write_capture
from gsdmsr_cli.cli.main import app
from gsdmsr_cli.formats import read_scene


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("reading")
    write_capture(folder, 9, 700, lambda *_: None)
    return folder


def test_the_capture_holds_what_is_asked_for(capture: Path) -> None:
    scene = read_scene(capture)
    assert (scene.layout, len(scene.views), len(scene.points)) == ("colmap", 9, 700)
    assert {(view.camera.width, view.camera.height) for view in scene.views} == {SIZE}
    # cameras look at the middle of the points from all round
    centres = np.stack([view.camera.centre for view in scene.views])
    assert np.linalg.norm(centres.mean(axis=0)) < 0.2 * np.linalg.norm(centres, axis=1).min()
    for view in scene.views:
        ahead = view.camera.rotation[2]
        assert ahead @ -view.camera.centre > 0.95 * np.linalg.norm(view.camera.centre)
    assert len({view.image_path.read_bytes() for view in scene.views}) == 9


def test_every_picture_is_told_of(tmp_path: Path) -> None:
    told: list[tuple[int, int]] = []
    write_capture(tmp_path, 3, 5, lambda done, total: told.append((done, total)))
    assert told == [(1, 3), (2, 3), (3, 3)]


def test_every_phase_is_measured(capture: Path) -> None:
    phases = list(measure(capture))
    assert len(phases) == 3
    assert all(phase.seconds > 0 for phase in phases)
    peaks = [phase.peak_mib for phase in phases if phase.peak_mib is not None]
    assert peaks == sorted(peaks)


def test_a_folder_in_use_is_refused(capture: Path) -> None:
    from typer.testing import CliRunner

    result = CliRunner().invoke(app, ["benchmark", "reading", "--out", str(capture)])
    assert "is not empty" in str(result.exception)
