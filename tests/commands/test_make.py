"""gsdmsr make: what it makes of a video and of a scene, and that it goes on after any end."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
import room

from gsdmsr_cli.commands import make
from gsdmsr_cli.commands._making import NOTE, Making, Request
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground.errors import DataError, GsdmsrError, UsageError

SHORT = "--budget", "3s", "--set", "splats.count=200", "--set", "data.downscale=2"

MADE = "run/eval/metrics.json", "run/eval/report.html", "run/eval/play.html"


def line_of(given: Path, out: Path, *words: str) -> list[str]:
    return [
        sys.executable, "-m", "gsdmsr_cli", "make", str(given), "--out", str(out), *SHORT, *words
    ]  # fmt: skip


def made(given: Path, out: Path, *words: str) -> dict[str, Any]:
    ended = subprocess.run(
        line_of(given, out, *words, "--json"), capture_output=True, text=True, check=False
    )
    assert ended.returncode == 0, ended.stderr
    document: dict[str, Any] = json.loads(ended.stdout)
    return document


def test_a_scene_ends_as_pages_and_films_and_nothing_is_done_twice(
    tiny_scene: Path, tmp_path: Path
) -> None:
    out = tmp_path / "made"
    told = made(tiny_scene, out)
    assert told["aggregate"]["psnr"] > 10
    for name in (*MADE, "run/render/test.webm", "run/render/orbit.webm"):
        assert (out / name).is_file(), name
    assert all(Path(path).is_file() for _, path in told["places"]) and len(told["places"]) == 4
    assert not (out / "scene").exists()
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*") if path.is_file()}
    assert made(tiny_scene, out) == told
    assert {p: p.stat().st_mtime_ns for p in out.rglob("*") if p.is_file()} == before
    shutil.rmtree(out / "run" / "eval")
    shutil.rmtree(out / "run" / "render")
    assert made(tiny_scene, out)["places"] == told["places"]
    for name in (*MADE, "run/render/test.webm", "run/render/orbit.webm"):
        assert (out / name).is_file(), name
    longer = made(tiny_scene, out, "--budget", "5s")
    training = json.loads((out / "run" / "training.json").read_text())
    assert training["train_s"] > 4.5 and longer["aggregate"] != told["aggregate"]


@pytest.mark.skipif(sys.platform == "win32", reason="there is no SIGKILL")
@pytest.mark.parametrize("until", ["run/metrics.jsonl", "run/eval/play.html", "run/render/test"])
def test_what_is_killed_goes_on(tiny_scene: Path, tmp_path: Path, until: str) -> None:
    out = tmp_path / "made"
    with subprocess.Popen(
        line_of(tiny_scene, out), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
        start_new_session=True,
    ) as process:  # fmt: skip
        deadline = time.monotonic() + 120
        while not (out / until).exists():
            assert time.monotonic() < deadline and process.poll() is None
            time.sleep(0.01)
        os.killpg(process.pid, signal.SIGKILL)
    told = made(tiny_scene, out)
    assert all(Path(path).is_file() for _, path in told["places"]) and len(told["places"]) == 4
    assert json.loads((out / NOTE).read_text())["done"].keys() == {"eval", "render"}


def test_of_a_film_a_scene_is_prepared_first(tmp_path: Path) -> None:
    film = room.write_film(tmp_path / "film.mp4", room.film(room.walk(14)), fps=5)
    out = tmp_path / "made"
    told = made(film, out, "--max-side", "200")
    assert told["aggregate"]["psnr"] > 10
    scene = read_scene(out / "scene")
    assert len(scene.views) == 14 and scene.views[0].camera.width == 200
    for name in (*MADE, "run/render/train.webm", "run/render/still.webm"):
        assert (out / name).is_file(), name
    assert made(film, out, "--max-side", "200") == told


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"preset": "hexplane"}, "was made with preset = None, not 'hexplane'"),
        ({"frames": 9}, "was made with frames = 240, not 9"),
        ({"overrides": ("density.cap=9",)}, "was made with set = "),
    ],
)
def test_another_order_is_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    video = tmp_path / "dog.mp4"
    video.write_bytes(b"film")
    first = Making(Request(video, tmp_path / "out"))
    first.claim()
    first.begin()
    Making(Request(video, tmp_path / "out", budget="1h")).claim()
    with pytest.raises(UsageError, match=message):
        Making(Request(video, tmp_path / "out", **change)).claim()
    video.write_bytes(b"another film")
    with pytest.raises(UsageError, match="was made with files"):
        Making(Request(video, tmp_path / "out")).claim()


def test_places_that_are_in_use_are_refused(tiny_scene: Path, tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(UsageError, match="holds something else"):
        Making(Request(tiny_scene, tmp_path)).claim()
    with pytest.raises(UsageError, match="is a file"):
        Making(Request(tiny_scene, tmp_path / "thesis.tex")).claim()
    with pytest.raises(DataError, match="not found; give a video"):
        Making(Request(tmp_path / "none.mp4", tmp_path / "out")).claim()
    own = tmp_path / "own"
    shutil.copytree(tiny_scene, own)
    for out in (own, tmp_path / "own" / ".."):
        with pytest.raises(UsageError, match=r"holds (INPUT|something else)"):
            Making(Request(own, out)).claim()
    assert not list(tmp_path.glob(NOTE)) and not list(own.glob(NOTE))


def test_options_are_checked_before_anything_is_done(tiny_scene: Path, tmp_path: Path) -> None:
    for bad in ({"preset": "nothing"}, {"overrides": ("density.capp=9",)}):
        with pytest.raises(GsdmsrError):
            make.run(Request(tiny_scene, tmp_path / "out", **bad))
    assert not (tmp_path / "out").exists()
