"""Trials through the real commands: done once, gone on with, and refused where they differ."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from gsdmsr_cli.benchmark import trials
from gsdmsr_cli.benchmark.trials import Terms, Trial, all_trials, run_side_by_side, run_trial
from gsdmsr_cli.calling import calls
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.limits import cores
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.runs.run import open_run

TERMS = Terms(downscale=1, background="white", split="test", lpips_weights=None)
STEPS = 4


def gsdmsr(*arguments: object) -> subprocess.CompletedProcess[str]:
    line = [sys.executable, "-m", "gsdmsr_cli", *map(str, arguments)]
    return subprocess.run(line, capture_output=True, text=True, timeout=300, check=False)


class Commands:
    """Stands for the commands: notes them down, and runs them if told to."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.lines: list[tuple[str, ...]] = []
        self.true = calls.call
        monkeypatch.setattr(trials, "call", self)

    def __call__(self, *arguments: str) -> None:
        self.lines.append(arguments)
        self.true(*arguments)

    def names(self) -> list[str]:
        names = [line[0] for line in self.lines]
        self.lines = []
        return names


@pytest.fixture
def commands(monkeypatch: pytest.MonkeyPatch) -> Commands:
    return Commands(monkeypatch)


@pytest.fixture(scope="module")
def finished(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of one finished trial."""
    root = tmp_path_factory.mktemp("trials")
    run_trial(Trial(tiny_scene, "static", STEPS, 1), root, TERMS)
    return root


@pytest.fixture
def copied(finished: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished, tmp_path / "trials"))


def test_trials_are_all_combinations_and_the_short_ones_come_first() -> None:
    found = all_trials([Path("a"), Path("b")], ["dnerf", "static"], ["2m", 30], [0, 1])
    assert len(found) == len(set(found)) == 16
    assert [t.length for t in found] == ["2m"] * 8 + [30] * 8
    assert [t.seed for t in found[:8]] == [0] * 4 + [1] * 4
    assert found[:4] == [
        Trial(Path(scene), preset, "2m", 0) for scene in "ab" for preset in ("dnerf", "static")
    ]
    assert len({t.folder(Path("out")) for t in found}) == 16


def test_two_scenes_of_one_name_are_refused() -> None:
    with pytest.raises(DataError, match="two scenes are called 'lego'"):
        all_trials([Path("x/lego"), Path("y/lego")], ["dnerf"], ["2m"], [0])


@pytest.mark.parametrize(("length", "expected"), [("90s", ("90s", 10000)), (7, (None, 7))])
def test_a_trial_has_its_own_length_and_seed(
    length: str | int, expected: tuple[str | None, int]
) -> None:
    terms = Terms(2, "black", "val", None)
    preset = load_preset("dnerf", None, Trial(Path("s"), "dnerf", length, 5).overrides(terms))
    assert (preset.training.budget, preset.training.steps) == expected
    assert preset.training.seed == 5
    assert (preset.data.downscale, preset.data.background) == (2, "black")


def test_all_trials_may_have_an_option_of_their_own() -> None:
    terms = Terms(1, "white", "test", None, overrides=("splats.count=9",))
    assert Trial(Path("s"), "dnerf", 7, 0).options(terms).splats.count == 9


@pytest.mark.parametrize("option", ["training.steps=9", "training.seed=1", "data.downscale=2"])
def test_an_option_that_the_terms_have_is_refused(option: str) -> None:
    terms = Terms(1, "white", "test", None, overrides=(option,))
    key = option.partition("=")[0]
    with pytest.raises(UsageError, match=f"--set {option}: trials have a {key} already"):
        Trial(Path("s"), "dnerf", "2m", 0).options(terms)


def test_a_length_that_does_not_exist_is_refused() -> None:
    with pytest.raises(UsageError, match="budget"):
        load_preset("dnerf", None, Trial(Path("s"), "dnerf", "8", 0).overrides(TERMS))


def test_a_trial_is_an_ordinary_run(finished: Path, tiny_scene: Path) -> None:
    run = open_run(Trial(tiny_scene, "static", STEPS, 1).folder(finished))
    assert run.load().step == STEPS
    assert (run.name, run.preset.training.seed) == ("static", 1)


def test_what_is_finished_is_not_done_again(
    finished: Path, tiny_scene: Path, commands: Commands
) -> None:
    document = run_trial(Trial(tiny_scene, "static", STEPS, 1), finished, TERMS)
    assert commands.lines == []
    assert document["training"]["steps"] == STEPS


def test_another_split_is_only_evaluated(
    copied: Path, tiny_scene: Path, commands: Commands
) -> None:
    trial, val = Trial(tiny_scene, "static", STEPS, 1), Terms(1, "white", "val", None)
    assert run_trial(trial, copied, val)["protocol"]["split"] == "val"
    assert commands.names() == ["eval"]


def test_a_report_without_the_weights_that_there_are_now_is_made_again(
    copied: Path, tiny_scene: Path, commands: Commands, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So is one of other weights, and of another checkpoint; not one of more than there is now."""
    trial = Trial(tiny_scene, "static", STEPS, 1)
    path = trial.folder(copied) / "eval" / "metrics.json"
    now = {"alex": {"trunk": "ab", "linear": "cd"}, "vgg": None}
    monkeypatch.setattr(trials, "weights_hashes", lambda folder: now)
    commands.true = lambda *line: None
    for change, again in (
        ({}, True),
        ({"lpips_weights": {"alex": None, "vgg": None}}, True),
        ({"lpips_weights": {"alex": {"trunk": "ab", "linear": "00"}}}, True),
        ({"lpips_weights": now}, False),
        ({"lpips_weights": {**now, "vgg": {"trunk": "ef", "linear": "12"}}}, False),
        ({"lpips_weights": now, "checkpoint_sha256": "of another"}, True),
    ):
        document = json.loads((trial.folder(copied) / "eval" / "metrics.json").read_text())
        before = path.read_bytes()
        document["protocol"] |= change
        path.write_text(json.dumps(document))
        run_trial(trial, copied, TERMS)
        assert commands.names() == (["eval"] if again else []), change
        path.write_bytes(before)


def test_a_training_that_was_cut_short_goes_on(
    copied: Path, tiny_scene: Path, commands: Commands
) -> None:
    trial = Trial(tiny_scene, "static", STEPS, 1)
    folder = trial.folder(copied)
    half = ["train", "--data", tiny_scene, "--out", folder, "--overwrite", "--preset", "static"]
    settings = [f"--set={setting}" for setting in trial.overrides(TERMS)]
    assert gsdmsr(*half, *settings, "--steps", STEPS // 2).returncode == 0
    about = json.loads((folder / "run.json").read_text(encoding="utf-8"))
    about["preset"]["training"]["steps"] = STEPS  # as if it had been killed there
    (folder / "run.json").write_text(json.dumps(about), encoding="utf-8")
    run = open_run(folder)
    saved = run.load()
    run.save(type(saved)(saved.step, 0.5, saved.elapsed, saved.tensors, saved.state))
    assert run_trial(trial, copied, TERMS)["training"]["steps"] == STEPS
    assert "--resume" in commands.lines[0]
    assert commands.names() == ["train", "eval"]


def test_a_training_with_other_options_is_refused(copied: Path, tiny_scene: Path) -> None:
    black = Terms(1, "black", "test", None)
    with pytest.raises(DataError, match="other options than 'static' has now"):
        run_trial(Trial(tiny_scene, "static", STEPS, 1), copied, black)


def test_a_training_of_other_data_is_refused(
    copied: Path, tiny_scene: Path, tmp_path: Path
) -> None:
    other = Path(shutil.copytree(tiny_scene, tmp_path / tiny_scene.name))
    layout = other / "transforms_val.json"
    layout.write_text(layout.read_text(encoding="utf-8") + "\n", encoding="utf-8")
    with pytest.raises(DataError, match="not the data"):
        run_trial(Trial(other, "static", STEPS, 1), copied, TERMS)


def test_the_table_of_a_benchmark(tiny_scene: Path, finished: Path, tmp_path: Path) -> None:
    """The finished trial comes from before; one further preset is trained."""
    out = Path(shutil.copytree(finished, tmp_path / "out"))
    line = ["benchmark", "scenes", tiny_scene, "--out", out, "--steps", STEPS, "--seed", 1]
    done = gsdmsr(*line, "--preset", "static", "--preset", "dnerf", "--json")
    assert done.returncode == 0, done.stderr
    folder = Trial(tiny_scene, "dnerf", STEPS, 1).folder(out)
    assert f"trial 2 of 2: {folder}\n" in done.stderr
    document = json.loads(done.stdout)
    assert document == json.loads((out / "table.json").read_text(encoding="utf-8"))
    assert [row["preset"] for row in document["rows"]] == ["static", "dnerf"]
    report = folder / "eval" / "metrics.json"
    scores = json.loads(report.read_text(encoding="utf-8"))["aggregate"]
    assert document["rows"][1]["psnr"] == scores["psnr"]
    assert f"| {scores['psnr']:.2f} |" in (out / "table.md").read_text(encoding="utf-8")
    assert {"test_psnr", "val_psnr", "train_psnr"} <= {
        k for k, v in document["rows"][1].items() if v
    }
    chart = (out / f"psnr-{tiny_scene.name}.svg").read_text(encoding="utf-8")
    assert ">static<" in chart and ">dnerf<" in chart


def test_a_file_of_options_competes_under_its_name(tiny_scene: Path, tmp_path: Path) -> None:
    config = tmp_path / "slow.yaml"
    config.write_text("base: static\noptimizer: {means: [1e-5, 1e-5]}\n", encoding="utf-8")
    trial = Trial(tiny_scene, config, STEPS, 1)
    assert trial.folder(Path("out")) == Path("out") / tiny_scene.name / f"slow-{STEPS}steps-1"
    assert run_trial(trial, tmp_path, TERMS)["protocol"]["motion"] == "static"
    run = open_run(trial.folder(tmp_path))
    assert run.preset.optimizer.means == (1e-5, 1e-5) and run.preset == trial.options(TERMS)


def test_two_presets_of_one_name_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="two presets are called 'dnerf'"):
        all_trials([tmp_path], ["dnerf", tmp_path / "dnerf.yaml"], ["2m"], [0])


@pytest.mark.parametrize(
    ("line", "code", "message"),
    [
        (["--preset", "static", "--preset", "dnref", "--steps", "4"], 2, "dnref"),
        (["--preset", "static", "--budget", "8"], 2, "budget"),
    ],
)
def test_bad_input_is_told_before_anything_is_trained(
    line: list[str], code: int, message: str, tiny_scene: Path, tmp_path: Path
) -> None:
    done = gsdmsr("benchmark", "scenes", tiny_scene, "--out", tmp_path / "out", *line)
    assert (done.returncode, done.stdout) == (code, "")
    assert done.stderr.count("\n") == 1 and message in done.stderr
    assert not (tmp_path / "out").exists()


def test_a_scene_that_is_none_is_told_before_anything_is_trained(
    tiny_scene: Path, tmp_path: Path
) -> None:
    (tmp_path / "empty").mkdir()
    out = tmp_path / "out"
    done = gsdmsr("benchmark", "scenes", tiny_scene, tmp_path / "empty", "--out", out, "--steps", 4)
    assert (done.returncode, out.exists()) == (3, False)
    assert "has no known layout" in done.stderr


def test_the_table_is_shown_whole_on_whatever_terminal(
    tiny_scene: Path, finished: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    line = ["benchmark", "scenes", tiny_scene, "--out", finished, "--preset", "static"]
    done = gsdmsr(*line, "--steps", STEPS, "--seed", 1)
    assert done.returncode == 0, done.stderr
    text = (finished / "table.md").read_text(encoding="utf-8").splitlines()[-1]
    cells = [cell.strip() for cell in text.strip("|").split("|")]
    shown = [line for line in done.stdout.splitlines() if tiny_scene.name in line]
    assert [cell.strip() for cell in shown[0].strip("│").split("│")] == cells
    assert "table.md" in done.stdout


@pytest.mark.skipif(cores() < 2, reason="one core")
def test_trials_side_by_side_share_the_cores(tiny_scene: Path, tmp_path: Path) -> None:
    two = [Trial(tiny_scene, "static", STEPS, seed) for seed in (1, 2)]
    terms = Terms(1, "white", "test", None, jobs=2)
    found = run_side_by_side(two, tmp_path, terms)
    assert [document["training"]["steps"] for document in found] == [STEPS, STEPS]
    threads = {open_run(trial.folder(tmp_path)).preset.training.threads for trial in two}
    assert threads == {cores() // 2}
    assert all("100%" in trial.log(tmp_path).read_text(encoding="utf-8") for trial in two)
    assert run_side_by_side(two, tmp_path, terms) == found


def test_more_trials_at_once_than_cores_are_refused(tiny_scene: Path, tmp_path: Path) -> None:
    line = ["benchmark", "scenes", tiny_scene, "--out", tmp_path / "out", "--steps", STEPS]
    for asked in ("--jobs", cores() + 1), ("--jobs", 1, "--threads", cores() + 1):
        done = gsdmsr(*line, *asked)
        assert (done.returncode, done.stdout) == (2, "")
        assert f"this machine has {cores()} cores" in done.stderr


def test_trials_have_the_threads_that_were_asked_for(tiny_scene: Path) -> None:
    trial, terms = Trial(tiny_scene, "static", STEPS, 0), Terms(1, "white", "test", None, 1, 3)
    assert trial.options(terms).training.threads == 3


@pytest.mark.parametrize(
    ("jobs", "how"),
    [(1, signal.SIGINT), (min(2, cores()), signal.SIGINT), (1, signal.SIGTERM)],
)
def test_ctrl_c_and_kill_save_the_training_that_is_under_way(
    jobs: int, how: signal.Signals, tiny_scene: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    line = ["benchmark", "scenes", tiny_scene, "--out", out, "--preset", "static", "--steps", 10**7]
    line += ["--jobs", jobs, "--seed", 0, "--seed", 1]
    process = subprocess.Popen(
        [sys.executable, "-m", "gsdmsr_cli", *map(str, line)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    begun = [Trial(tiny_scene, "static", 10**7, seed) for seed in range(jobs)]
    curves = [trial.folder(out) / "metrics.jsonl" for trial in begun]
    deadline = time.monotonic() + 300
    while not all(curve.is_file() for curve in curves) and time.monotonic() < deadline:
        assert process.poll() is None, process.communicate()
        time.sleep(0.05)
    os.killpg(process.pid, how)  # as a terminal does, to the processes in front
    _, error = process.communicate(timeout=60)
    assert process.returncode == 130
    for trial in begun:
        shown = error if jobs == 1 else trial.log(out).read_text(encoding="utf-8")
        assert "interrupted at step" in shown
        assert open_run(trial.folder(out)).load().step > 0
