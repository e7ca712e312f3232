"""gsdmsr train --stream: what it leaves, how it is read, and what becomes of it if it is ended."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from rigs import write_rig
from stream_checks import EACH, FIRST, MOMENTS, NEWCOMERS, OPTIONS, WAYS

from gsdmsr_cli.benchmark.kills import same
from gsdmsr_cli.model.building import load_model
from gsdmsr_cli.model.motion.cells import Options
from gsdmsr_cli.moving.container import from_bytes
from gsdmsr_cli.moving.decoding import decoded
from gsdmsr_cli.moving.playing import model_of
from gsdmsr_cli.runs import moments
from gsdmsr_cli.runs.run import open_run, open_with_model
from gsdmsr_cli.training.streaming.loop import MomentReport
from gsdmsr_cli.viewing.showing import Showing

SETTINGS = [f"--set={option}" for option in OPTIONS]
STEPS = FIRST + (MOMENTS - 1) * EACH

Gsdmsr = Callable[..., int]


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_rig(tmp_path_factory.mktemp("rig"), moments=MOMENTS)


@pytest.fixture
def run(rig: Path, tmp_path: Path, gsdmsr: Gsdmsr) -> Path:
    """A stream that has come to its end."""
    assert gsdmsr("train", "--stream", "--data", rig, "--out", tmp_path / "run", *SETTINGS) == 0
    return tmp_path / "run"


MOTIONS = {
    "persistent": "tracks", "hicom": "cells", "scale-gs": "cells",
    "3dgstream": "transformation_cache",
}  # fmt: skip


@pytest.fixture(params=[*WAYS, "newcomers"])
def any_run(
    rig: Path, tmp_path: Path, gsdmsr: Gsdmsr, request: pytest.FixtureRequest
) -> tuple[str, Path]:
    """A stream of each way, and one with newcomers, that has come to its end; and the way."""
    way, out, further = request.param, tmp_path / "run", list[str]()
    if way == "newcomers":
        way, further = "persistent", [f"--set={NEWCOMERS}"]
    given = "--stream", "--preset", way, "--data", rig, "--out", out
    assert gsdmsr("train", *given, *SETTINGS, *further) == 0
    return way, out


def files_of(run: Path) -> dict[str, bytes]:
    """The moments' files without what they say of wall time."""
    found = {}
    for moment in moments.there(run):
        data = moments.path_of(run, moment).read_bytes()
        length = int.from_bytes(data[:8], "little")
        about = json.loads(json.loads(data[8 : 8 + length])["__metadata__"]["gsdmsr"])
        about["told"].pop("elapsed")
        found[f"{moment} {json.dumps(about)}"] = data[8 + length :]
    return found


def test_it_leaves_a_small_file_for_each_moment(run: Path) -> None:
    assert moments.there(run) == [*range(MOMENTS)]
    entries = [entry for entry in open_run(run).read_log() if entry["bytes"]]
    assert [entry["moment"] for entry in entries] == [*range(MOMENTS)]
    sizes = [moments.path_of(run, moment).stat().st_size for moment in range(MOMENTS)]
    assert [entry["bytes"] for entry in entries] == sizes
    assert all(entry["val_psnr"] > 5 and entry["moment_s"] > 0 for entry in entries)
    opened = open_run(run)
    assert (opened.load().step, opened.load().progress) == (STEPS, 1.0)
    assert opened.account(STEPS)["progress"] == 1.0 and opened.name == "persistent"


def test_other_commands_take_it_as_any_run(
    any_run: tuple[str, Path],
    tmp_path: Path,
    gsdmsr: Gsdmsr,
    capsys: pytest.CaptureFixture[str],
) -> None:
    way, run = any_run
    assert gsdmsr("info", run, "--json") == 0
    facts = json.loads(capsys.readouterr().out)["facts"]
    assert facts["motion"] == MOTIONS[way] and facts["moments"] == f"{MOMENTS} of {MOMENTS}"
    assert gsdmsr("eval", run, "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert len(document["frames"]) == MOMENTS
    sizes = [moments.path_of(run, moment).stat().st_size for moment in range(MOMENTS)]
    assert document["storage"]["checkpoint_bytes"] == sum(sizes)
    first = moments.read(run, 0).tensors
    assert any(name.startswith("motion.") for name in first) == (MOTIONS[way] == "cells")
    own = sum(tensor.nbytes for name, tensor in first.items() if not name.startswith("splats."))
    assert document["storage"]["motion_bytes"] == own + sum(sizes[1:])
    film = "--path", "still", "--view", "train/c0_000", "--frames", 2
    assert gsdmsr("render", run, *film, "--out", tmp_path / "film") == 0
    for format_, name in (("ply", "a.ply"), ("moving", "a.dsplat"), ("compact", "packed")):
        when = ["--time", "0.5"] if format_ == "ply" else []
        assert gsdmsr("export", run, "--format", format_, *when, "--out", tmp_path / name) == 0
    _, model, _ = open_with_model(run)
    _, packed, _ = open_with_model(tmp_path / "packed")
    assert len(packed.splats) == len(model.splats)


def test_what_is_read_is_what_was_trained_but_for_rounding(any_run: tuple[str, Path]) -> None:
    way, run = any_run
    opened, model, _ = open_with_model(run)
    trained = opened.load().tensors
    step = opened.preset.stream.place_step
    off = (model.tensors()["motion.offsets"] - trained["motion.offsets"]).abs().max()
    assert 0 < off <= step / 2 + 1e-6
    before = model.tensors()["motion.past_offsets"][:, -1]
    assert (before - trained["motion.past_offsets"][:, 0]).abs().max() <= step / 2 + 1e-6
    assert torch.equal(model.splats.sh, trained["splats.sh"])
    rows = len(model.tensors()["motion.offsets"])
    assert (rows < len(model.splats)) == (MOTIONS[way] == "cells")
    preset = opened.preset
    whole = load_model(trained, preset.motion, preset.layers, opened.facts, progress=1.0)
    found, true = (own.at(own.instant(1.0)).splats for own in (model, whole))
    assert not torch.equal(true.means, model.splats.means)
    near = step / 2 * opened.facts.bound + 1e-5
    if MOTIONS[way] == "cells":
        # a cell's turn is off by as much, and moves what is far from its middle
        arm = (model.splats.means - model.splats.means.mean(dim=0)).norm(dim=1).max()
        near = len(Options().splats) * (near + 2 * preset.stream.turn_step * float(arm))
    assert (found.means - true.means).abs().max() <= near


def test_a_stream_that_goes_on_can_be_looked_at(
    run: Path, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    moments.rewind(run, 2)
    assert gsdmsr("eval", run, "--json") == 0
    said = capsys.readouterr()
    times = {frame["time"] for frame in json.loads(said.out)["frames"]}
    assert times == {0.0, 1 / (MOMENTS - 1)}
    assert f"2 of {MOMENTS} moments are there" in said.err
    moments.rewind(run, 0)
    assert gsdmsr("info", run) == 0  # during the first moment there is the checkpoint


def call(rig: Path, out: Path, *options: str) -> list[str]:
    command = [sys.executable, "-m", "gsdmsr_cli", "train", "--data", str(rig), "--out", str(out)]
    return [*command, *options]


def wait_for(holds: Callable[[], object]) -> None:
    end = time.monotonic() + 300
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.01)


@pytest.mark.skipif(sys.platform == "win32", reason="no such signals there")
@pytest.mark.parametrize("end", [signal.SIGINT, signal.SIGKILL], ids=["Ctrl-C", "kill -9"])
def test_a_stream_that_is_ended_goes_on_to_the_same_end(
    rig: Path, tmp_path: Path, gsdmsr: Gsdmsr, end: signal.Signals
) -> None:
    longer = [*SETTINGS, "--set=stream.steps=40"]
    whole, ended = tmp_path / "whole", tmp_path / "ended"
    assert gsdmsr("train", "--stream", "--data", rig, "--out", whole, *longer) == 0
    with subprocess.Popen(
        call(rig, ended, "--stream", *longer), stderr=subprocess.DEVNULL, start_new_session=True
    ) as training:
        wait_for(lambda: len(moments.there(ended)) >= 2)
        training.send_signal(end)
        assert training.wait(timeout=60) == (130 if end == signal.SIGINT else -9)
    there = moments.there(ended)
    assert len(there) >= 2 and there == [*range(len(there))]
    if len(there) < MOMENTS:
        assert gsdmsr("eval", ended) == 0
        assert gsdmsr("train", "--resume", "--data", rig, "--out", ended) == 0
    assert same(open_run(ended).load(), open_run(whole).load())
    assert files_of(ended) == files_of(whole)
    steps = [entry["step"] for entry in open_run(ended).read_log()]
    assert steps == sorted(set(steps))


def test_a_complete_stream_is_not_resumed_and_an_earlier_one_is_replaced(
    run: Path, rig: Path, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    assert gsdmsr("train", "--resume", "--stream", "--data", rig, "--out", run) == 2
    assert "is complete at step" in capsys.readouterr().err
    fewer = [*SETTINGS, "--set=stream.steps=1", "--steps", "2", "--overwrite"]
    assert gsdmsr("train", "--stream", "--data", rig, "--out", run, *fewer) == 0
    assert open_run(run).load().step == 2 + MOMENTS - 1
    assert gsdmsr("train", "--preset", "static", "--steps", 2, "--overwrite", "--data", rig,
                  "--out", run, "--set", "splats.count=50") == 0  # fmt: skip
    assert not (run / moments.FOLDER).exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--preset", "n3v"], "motion.name is multiscale, which is not learnt moment after moment"),
        (["--set", "stream.budget=ten"], 'stream.budget is "ten"; allowed: null or a positive'),
    ],
)
def test_options_that_do_not_fit_are_refused_in_one_line(
    rig: Path, tmp_path: Path, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str],
    options: list[str], message: str,
) -> None:  # fmt: skip
    assert gsdmsr("train", "--stream", "--data", rig, "--out", tmp_path / "run", *options) == 2
    said = capsys.readouterr().err
    assert message in said and said.count("\n") == 1 and not (tmp_path / "run").exists()


def test_one_camera_is_refused_in_one_line(
    tiny_scene: Path, tmp_path: Path, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    assert gsdmsr("train", "--stream", "--data", tiny_scene, "--out", tmp_path / "run") == 3
    said = capsys.readouterr().err
    assert "one camera sees each moment" in said and said.count("\n") == 1


def test_a_moment_without_a_camera_is_named_and_learnt(
    tmp_path: Path, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    data = write_rig(tmp_path / "data", cameras=4, moments=3, missing=[(1, 2)])
    out = tmp_path / "run"
    assert gsdmsr("train", "--stream", "--data", data, "--out", out, *SETTINGS) == 0
    assert "moment 1 (time 0.5) lacks 1 of 4 cameras" in capsys.readouterr().err
    assert moments.there(out) == [0, 1, 2]


def test_a_dry_run_says_how_many_moments_there_are(
    rig: Path, tmp_path: Path, gsdmsr: Gsdmsr, capsys: pytest.CaptureFixture[str]
) -> None:
    line = "train", "--stream", "--dry-run", "--data", rig, "--out", tmp_path / "run", *SETTINGS
    assert gsdmsr(*line, "--json") == 0
    plan = json.loads(capsys.readouterr().out)
    assert (plan["moments"], plan["each_moment"]) == (MOMENTS, f"{EACH} steps")


def test_a_report_of_a_moment_that_is_over_tells_its_time_and_bytes() -> None:
    given = {
        "step": 900, "elapsed": 60.0, "progress": 0.2, "loss": 0.1, "splats": 9, "salient": 1.0,
        "still": 0.0, "dropped": 0, "ms_per_step": 5.0, "psnr": 25.0, "split": "val", "timings": {},
    }  # fmt: skip
    during = MomentReport(**given, moment=1, moments=10, seconds=4.0)
    over = MomentReport(**given, moment=1, moments=10, seconds=8.0, bytes=12345)
    assert (during.place, during.always_told) == ("moment 2 of 10  ", False)
    assert during.remaining == 240.0
    assert over.place == "moment 2 of 10 in 8.0 s, 12,345 bytes  " and over.always_told
    assert over.remaining == 8 * 8.0
    assert over.entry()["bytes"] == 12345 and over.entry()["moment_s"] == 8.0
    first = replace(over, moment=0, seconds=60.0)
    assert first.remaining == 240.0, "later moments are not as long as the first"


def test_the_page_of_a_stream_plays_the_moments_that_are_over(run: Path) -> None:
    moments.rewind(run, 3)
    scene = Showing(run, "", {}, None).pages()["/scene.dsplat"]()
    assert scene is not None
    played = model_of(decoded(*from_bytes(scene.data)))
    _, model, _ = open_with_model(run)
    for when in (0.0, 1 / 3, 2 / 3, 1.0):
        found, expected = (one.at(one.instant(when)).splats.means for one in (played, model))
        torch.testing.assert_close(found.mean(dim=0), expected.mean(dim=0), rtol=0, atol=2e-3)
