"""A run is served with its newest splats, how it stands, and a held-out view beside its truth."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from urllib.error import HTTPError

import cv2
import numpy as np
import pytest
from served_pages import get, view
from training_checks import begun_run

from gsdmsr_cli.moving.container import from_bytes
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.viewing.showing import MOST_POINTS, _curve, _time_left
from gsdmsr_cli.viewing.snapshots import snapshot_path

QUICK = "splats.count=200", "training.static_until=0", "training.threads=1"


@pytest.fixture
def run(tiny_scene: Path, tmp_path: Path) -> Path:
    run = begun_run(tiny_scene, tmp_path / "run", QUICK)
    run.log({"step": 5, "elapsed": 60.0, "progress": 0.25, "splats": 200, "val_psnr": 20.5})
    run.log({"step": 9, "elapsed": 120.0, "progress": 0.5, "splats": 200, "val_psnr": 21.5})
    return run.root


def test_a_run_is_served(run: Path) -> None:
    with view(run) as address:
        assert address.startswith("http://127.0.0.1:")
        page = get(address).decode()
        assert 'data-url="scene.dsplat"' in page and "data-live" in page
        header, parts = from_bytes(get(address, "scene.dsplat"))
        assert header["splats"] <= 200 and "means" in parts and header["scene"]["seconds"] > 0
        state: dict[str, Any] = json.loads(get(address, "state.json"))
        assert state["curve"] == [[1.0, 20.5], [2.0, 21.5]] and state["preset"] == "dnerf"
        assert state["running"] and state["remaining"] == 120.0 and state["held_out"]
        pictures = [get(address, name) for name in ("drawn.png", "truth.png")]
        sizes = {cv2.imdecode(np.frombuffer(png, np.uint8), -1).shape for png in pictures}
        assert len(sizes) == 1
        assert (run / "view" / "wanted").is_file()  # somebody has looked
        snapshot_path(run).write_bytes(b"newer splats")
        os.utime(snapshot_path(run), (time.time() + 5,) * 2)
        assert json.loads(get(address, "state.json"))["scene"] != state["scene"]
        assert get(address, "scene.dsplat") == b"newer splats"
        with pytest.raises(HTTPError, match="503"):  # which are none, and do no harm
            get(address, "drawn.png")


def test_a_file_is_served_without_its_data(run: Path, tmp_path: Path) -> None:
    file = tmp_path / "a.dsplat"
    line = [sys.executable, "-m", "gsdmsr_cli", "export", run, "--format", "moving", "--out", file]
    subprocess.run(list(map(str, line)), check=True, capture_output=True)
    with view(file) as address:
        assert get(address, "scene.dsplat") == file.read_bytes()
        state = json.loads(get(address, "state.json"))
        assert not state["running"] and not state["held_out"] and state["curve"] == []
        with pytest.raises(HTTPError, match="404"):
            get(address, "truth.png")


@pytest.mark.parametrize(
    ("words", "code", "said"),
    [
        (("--port", 70000), 2, "port"),
        (("--host", "203.0.113.7"), 2, "cannot listen at 203.0.113.7"),
        (("--data", "nowhere"), 3, "nowhere"),
    ],
)
def test_what_cannot_be_served_is_one_line(
    run: Path, words: tuple[object, ...], code: int, said: str
) -> None:
    line = [sys.executable, "-m", "gsdmsr_cli", "view", run, *words]
    done = subprocess.run(list(map(str, line)), check=False, capture_output=True, text=True)
    assert done.returncode == code and said in done.stderr and "Traceback" not in done.stderr


def test_no_run_is_one_line(tmp_path: Path) -> None:
    line = [sys.executable, "-m", "gsdmsr_cli", "view", str(tmp_path)]
    done = subprocess.run(line, check=False, capture_output=True, text=True)
    assert done.returncode == 3 and "not a run folder" in done.stderr


@pytest.mark.parametrize(
    ("preset", "length", "left"),
    [
        ("video", ["training.budget=4m", "training.budget_power=0.5"], 900.0),  # 1 / 16 is over
        ("video", ["training.steps=100", "training.budget_power=0.5"], 180.0),
        ("persistent", ["training.budget=4m", "training.budget_power=0.5"], 180.0),
    ],
)
def test_time_is_left_as_progress_goes_with_time(
    preset: str, length: list[str], left: float
) -> None:
    """A stream's progress is a share of its moments, each of which has a length of its own."""
    run: Any = SimpleNamespace(preset=load_preset(preset, None, length))
    assert _time_left(run, 60.0, 0.25) == pytest.approx(left)


def test_a_long_curve_is_thinned_and_keeps_its_end() -> None:
    log = [{"elapsed": 60.0 * i, "val_psnr": float(i)} for i in range(5 * MOST_POINTS + 3)]
    curve = _curve(log)
    assert len(curve) <= MOST_POINTS and curve[-1] == [5 * MOST_POINTS + 2, 5 * MOST_POINTS + 2]
