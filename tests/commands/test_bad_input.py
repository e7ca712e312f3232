"""What a user can get wrong ends in one line and an exit code, and spoils nothing."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from datasets import noise, write_picture
from training_checks import begun_run, run_of, trainer_of

from gsdmsr_cli.commands import _beginning
from gsdmsr_cli.commands import train as train_command
from gsdmsr_cli.commands._trained import open_trained
from gsdmsr_cli.drawing.splatting import draw
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground import files, locks
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.runs import checkpoints
from gsdmsr_cli.runs.beginning import continue_run, create_run, refuse_used
from gsdmsr_cli.runs.run import Run, open_run
from gsdmsr_cli.scene import imaging

Gsdmsr = Callable[..., int]

FEW = ("splats.count=20", "splats.start=box", "motion={name: static}")


@pytest.fixture
def run(tiny_scene: Path, tmp_path: Path) -> Run:
    """A run that has made no step."""
    return begun_run(tiny_scene, tmp_path / "a [b] [/x] :smile:", FEW)


def one_line(capsys: pytest.CaptureFixture[str]) -> str:
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("error: ") and err.count("\n") == 1
    return err


USAGE = {
    "unknown preset": ("--preset dnref", "did you mean 'dnerf'?"),
    "unknown key": ("--set training.stepz=3", "training.stepz.*did you mean 'steps'?"),
    "unknown motion": ("--set motion.name=multiscal", "did you mean 'multiscale'?"),
    "unknown option of a motion": (
        "--set motion.widht=3",
        r"--set motion\.widht=3.*did you mean 'width'\?",
    ),
    "unknown event": ("--set events=[densty]", "unknown event 'densty'; did you mean 'density'"),
    "an event twice": ("--set events=[density,density]", "events names 'density' twice; drop one"),
    "unknown option of an event": (
        '--set events=[{"name":"density","evry":3}]',
        "unknown key 'evry'",
    ),
    "an event that is no name": ("--set events=[3]", "events.*allowed: "),
    "unknown term of the loss": (
        '--set losses.terms=[{"name":"rigidty"}]',
        "unknown term of the loss 'rigidty'; did you mean 'rigidity'",
    ),
    "unknown layer": ('--set layers=[{"name":"fade"}]', "unknown layer 'fade'; known: cameras, "),
    "no value": ("--set training.steps", "a.b=value"),
    "no mapping": ("--set training=3 --steps 4", "training is 3; allowed: a mapping"),
    "bad budget": ("--budget 8x", "allowed: null or a positive duration"),
    "half precision": (
        "--set training.precision=bf16 --device cpu",
        "training.precision is bf16; allowed on the CPU: float32; --device cpu was given$",
    ),
    "no steps": ("--steps 0", "steps is 0; allowed: 1 or more"),
    "downscale of nothing": ("--downscale 0", "downscale is 0; allowed: 1 or more"),
    "downscale beyond the picture": (
        "--preset dnerf --downscale 49",
        "48 x 48 px.*allowed: 1 to 48",
    ),
}


@pytest.mark.parametrize(("options", "message"), USAGE.values(), ids=USAGE)
def test_options_that_do_not_exist_are_refused(
    gsdmsr: Gsdmsr, tiny_scene: Path, tmp_path: Path, capsys: Any, options: str, message: str
) -> None:
    out = tmp_path / "run"
    assert gsdmsr("train", "--data", tiny_scene, "--out", out, *options.split()) == 2
    assert re.search(message, one_line(capsys))
    assert not out.exists()


SIZES = {
    "training.views_per_step=17": "training.views_per_step is 17; allowed: 1 to 16",
    "motion={name: hexplane, levels: [2, 2, 2, 2, 2, 2, 2, 2, 2]}": (
        "levels is [2, 2, 2, 2, 2, 2, 2, 2, 2]; allowed: 1 to 8 whole numbers, each 2 or more"
    ),
    "motion={name: multiscale, channels: 24}": (
        "channels is 24; allowed: a multiple of 16, 16 or more"
    ),
}


@pytest.mark.parametrize(("option", "message"), SIZES.items(), ids=SIZES)
def test_sizes_that_no_kernel_serves_are_refused_before_the_data_is_looked_for(
    gsdmsr: Gsdmsr, tmp_path: Path, capsys: Any, option: str, message: str
) -> None:
    nowhere, out = tmp_path / "nowhere", tmp_path / "run"
    options = "--preset", "dnerf", "--set", option
    assert gsdmsr("train", "--data", nowhere, "--out", out, *options) == 2
    assert one_line(capsys).endswith(f": {message}\n")
    assert not out.exists()


def test_half_precision_is_refused_where_no_gpu_is_found(
    gsdmsr: Gsdmsr, tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    out, option = tmp_path / "run", "training.precision=fp16"
    assert gsdmsr("train", "--data", tiny_scene, "--out", out, "--set", option) == 2
    said = one_line(capsys)
    assert "is fp16; allowed on the CPU: float32; --device auto takes the CPU, since torch" in said
    assert not out.exists()


def test_a_run_of_half_precision_is_drawn_on_the_cpu_but_not_trained_there(
    gsdmsr: Gsdmsr, tiny_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    options = "splats.count=20", "splats.start=box", "training.precision=bf16"
    trainer = trainer_of(tiny_scene, load_preset("dnerf", None, options))
    made = run_of(trainer, tmp_path / "run")
    made.save(trainer.checkpoint())
    before = {path: path.read_bytes() for path in made.root.iterdir()}
    assert gsdmsr("train", "--data", tiny_scene, "--out", made.root, "--resume") == 2
    assert "training.precision is bf16; allowed on the CPU: float32" in one_line(capsys)
    assert {path: path.read_bytes() for path in made.root.iterdir()} == before
    with open_trained(made.root, None) as trained:
        renderer = trained.renderer
    trainer.restore(made.load())
    assert renderer.model.precision == trainer.model.precision == "bf16"
    view = trainer.scene.split("test")[0]
    frame = draw(renderer.model, view.camera, view.time, renderer.engine, renderer.background)
    assert frame.rgb.isfinite().all()


def test_a_scalar_in_a_file_is_not_lost_under_an_override(tmp_path: Path) -> None:
    config = tmp_path / "mine.yaml"
    config.write_text("losses: 1\ntraining: 3\n")
    with pytest.raises(UsageError, match=r"mine\.yaml:2: training is 3; allowed: a mapping"):
        load_preset(None, config, ["training.steps=4"])


@pytest.mark.parametrize("content", ['{"speed": 3}', "[]", "{"])
def test_overwrite_spares_a_folder_whose_run_json_is_of_another_program(
    gsdmsr: Gsdmsr, tiny_scene: Path, tmp_path: Path, capsys: Any, content: str
) -> None:
    (tmp_path / "run.json").write_text(content)
    (tmp_path / "thesis.tex").touch()
    assert gsdmsr("train", "--data", tiny_scene, "--out", tmp_path, "--overwrite") == 3
    assert "exists and is not a run folder" in one_line(capsys)
    assert (tmp_path / "thesis.tex").is_file() and (tmp_path / "run.json").is_file()


def test_a_place_below_a_file_is_refused_at_once(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(DataError, match=r"run: cannot be made, since .*file is a file"):
        refuse_used(tmp_path / "file" / "a" / "run", overwrite=True)


def test_overwriting_keeps_the_folder_itself(run: Run, tiny_scene: Path) -> None:
    """It may be a mounted disk, which cannot be removed, or somebody's link."""
    (run.root / "link").symlink_to(tiny_scene, target_is_directory=True)
    before = run.root.stat().st_ino
    create_run(run.root, "again", run.preset, run.facts, read_scene(tiny_scene), overwrite=True)
    assert {path.name for path in run.root.iterdir()} == {"run.json", "pictures.json", "link"}
    assert run.root.stat().st_ino == before and (tiny_scene / "train").is_dir()


@pytest.mark.skipif(sys.platform == "win32", reason="folders cannot be locked there")
def test_a_folder_in_which_another_training_writes_is_left_alone(
    gsdmsr: Gsdmsr, run: Run, tiny_scene: Path, capsys: Any
) -> None:
    before = run.checkpoint_path.read_bytes()
    for how in ("--resume", "--overwrite"):
        with locks.sole_writer(run.root):
            assert gsdmsr("train", "--data", tiny_scene, "--out", run.root, how) == 3
        assert "another process is writing there" in one_line(capsys)
    assert run.checkpoint_path.read_bytes() == before


@pytest.mark.skipif(sys.platform == "win32", reason="folders cannot be locked there")
@pytest.mark.parametrize("how", ["--resume", "--overwrite"])
def test_a_training_holds_its_folder_from_the_first_look_to_the_last_word(
    gsdmsr: Gsdmsr, run: Run, tiny_scene: Path, monkeypatch: Any, how: str
) -> None:
    asked: list[str] = []

    def ask(moment: str, module: ModuleType = train_command) -> None:
        real = getattr(module, moment)

        def asking(*given: Any) -> Any:
            asked.append(moment)
            with pytest.raises(DataError, match="another process"), locks.sole_writer(run.root):
                pass
            return real(*given)

        monkeypatch.setattr(module, moment, asking)

    first = "open_run" if how == "--resume" else "refuse_used"
    ask(first, _beginning)
    for moment in ("read", "write_json"):
        ask(moment)
    few = [part for option in FEW for part in ("--set", option)]
    options = [*few, "--steps", 1, "--set", "training.threads=1", how]
    assert gsdmsr("train", "--data", tiny_scene, "--out", run.root, *options) == 0
    assert asked == [first, "read", "write_json"]
    with locks.sole_writer(run.root):
        assert run.training_path.is_file()


def test_bad_data_leaves_no_folder(gsdmsr: Gsdmsr, tmp_path: Path) -> None:
    out = tmp_path / "run"
    (tmp_path / "data").mkdir()
    assert gsdmsr("train", "--data", tmp_path / "data", "--out", out) == 3
    assert not out.exists()


def test_a_full_disk_is_told_before_the_training_not_after_it(
    gsdmsr: Gsdmsr, tiny_scene: Path, tmp_path: Path, capsys: Any, monkeypatch: Any
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoints, "save_file", full)
    monkeypatch.setattr(train_command, "train", lambda *_: pytest.fail("it trains"))
    options = ["--preset=dnerf", *(f"--set={option}" for option in FEW)]
    assert gsdmsr("train", "--data", tiny_scene, "--out", tmp_path / "run", *options) == 3
    assert "checkpoint.safetensors: cannot be written" in one_line(capsys)


def test_a_document_that_cannot_be_written_leaves_nothing(tmp_path: Path) -> None:
    (tmp_path / "a.json").mkdir()
    with pytest.raises(DataError, match=r"a\.json: cannot be written"):
        files.write_json(tmp_path / "a.json", {"x": 1})
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]


def test_a_folder_without_leave_to_write_is_told(tmp_path: Path, monkeypatch: Any) -> None:
    files.require_folder(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b").is_dir()
    monkeypatch.setattr(files.os, "access", lambda *_: False)  # root may write everywhere
    with pytest.raises(
        DataError, match="b: cannot be written; choose another --out or change the rights"
    ):
        files.require_folder(tmp_path / "a" / "b")


def test_what_a_killed_training_was_writing_is_cleared_away(run: Run, tiny_scene: Path) -> None:
    ours, others = f".gsdmsr-{'4f' * 16}.part", {".tmpAbc123", ".mine.part.json"}
    for name in (f"{ours}.json", *others):
        (run.root / name).touch()
    (run.root / ours).mkdir()
    (run.root / ours / "checkpoint.safetensors").touch()
    continue_run(run, run.preset, read_scene(tiny_scene))
    files = {path.name for path in run.root.iterdir()}
    assert files == {"run.json", "pictures.json", "checkpoint.safetensors", *others}


@pytest.mark.parametrize(
    "motion", [{"name": "nope"}, {"name": "hexplane"}, {"name": "static", "a": 1}]
)
@pytest.mark.parametrize("command", ["eval", "render", "export"])
def test_a_description_that_does_not_fit_the_checkpoint_is_bad_data(
    gsdmsr: Gsdmsr, run: Run, capsys: Any, motion: dict[str, Any], command: str
) -> None:
    path = run.root / "run.json"
    document = json.loads(path.read_text())
    document["preset"]["motion"] = motion
    path.write_text(json.dumps(document))
    more = ["--format", "ply", "--out", run.root / "x.ply"] if command == "export" else []
    assert gsdmsr(command, run.root, *more) == 3
    assert f"{run.root}: its model cannot be loaded" in one_line(capsys)


def test_a_damaged_description_is_named_once(run: Run) -> None:
    path = run.root / "run.json"
    document = json.loads(path.read_text())
    document["preset"]["training"]["stepz"] = 1
    path.write_text(json.dumps(document))
    with pytest.raises(DataError, match=r"preset: unknown key 'training\.stepz'") as caught:
        open_run(run.root)
    assert str(caught.value).count("run.json") == 1


def test_names_of_folders_are_printed_as_they_are(gsdmsr: Gsdmsr, run: Run, capsys: Any) -> None:
    target = run.root / "x.ply"
    assert gsdmsr("export", run.root, "--format", "ply", "--out", target) == 0
    assert capsys.readouterr().out == f"wrote {target}: 20 splats\n"
    assert gsdmsr("render", run.root, "--path", "orbit", "--frames", 1) == 0
    assert f"wrote {run.root / 'render' / 'orbit'}.webm and 1 pictures" in capsys.readouterr().out
    assert gsdmsr("eval", run.root, "--split", "val") == 0
    assert f"written to {run.root / 'eval' / 'metrics.json'}\n" in capsys.readouterr().out


def test_eval_of_data_that_has_changed_is_refused(
    gsdmsr: Gsdmsr, run: Run, tiny_scene: Path, tmp_path: Path, capsys: Any
) -> None:
    there = tmp_path / "there"
    shutil.copytree(tiny_scene, there)
    path = there / "transforms_train.json"
    document = json.loads(path.read_text())
    document["frames"].pop()
    path.write_text(json.dumps(document))
    assert gsdmsr("eval", run.root, "--data", there) == 3
    assert "is not the data that" in one_line(capsys)
    assert gsdmsr("eval", run.root, "--downscale", 49) == 2
    assert "allowed: 1 to 48" in one_line(capsys)
    assert not (run.root / "eval").exists()


def test_eval_without_checkpoint_or_frames_or_room_is_one_line(
    gsdmsr: Gsdmsr, run: Run, tiny_scene: Path, tmp_path: Path, capsys: Any
) -> None:
    (run.root / "eval").touch()
    assert gsdmsr("eval", run.root) == 3
    assert f"{run.root / 'eval'}: cannot be made: File exists" in one_line(capsys)
    assert gsdmsr("eval", tmp_path) == 3
    assert "not a run folder" in one_line(capsys)
    run.checkpoint_path.unlink()
    assert gsdmsr("eval", run.root) == 3
    assert "the run has no checkpoint yet" in one_line(capsys)


def test_a_split_without_frames_is_one_line(
    gsdmsr: Gsdmsr, tiny_scene: Path, tmp_path: Path, capsys: Any
) -> None:
    there = shutil.copytree(tiny_scene, tmp_path / "there")
    path = there / "transforms_val.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"frames": []}))
    options = [part for option in FEW for part in ("--set", option)]
    out = tmp_path / "run"
    assert gsdmsr("train", "--data", there, "--out", out, "--steps", 1, *options) == 0
    capsys.readouterr()
    assert gsdmsr("eval", out, "--split", "val") == 3
    assert "split 'val' has no frames; found train 12, test 4" in one_line(capsys)
    assert not (out / "eval").exists()


@pytest.mark.parametrize("part", ["below a file", "a file"])
def test_the_demo_says_where_it_cannot_be(
    gsdmsr: Gsdmsr, tmp_path: Path, capsys: Any, part: str
) -> None:
    (tmp_path / "file").touch()
    below = part == "below a file"
    out = tmp_path / "file" / "x" if below else tmp_path / "file"
    assert gsdmsr("demo", "--out", out) == (3 if below else 2)
    assert str(out) in one_line(capsys)


def test_a_png_with_a_wrong_bit_is_refused_without_a_word_from_libpng(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "a.png"
    write_picture(path, noise(40, 40))
    whole = path.read_bytes()
    assert imaging.read_image(path).shape == (40, 40, 4)
    for place in np.linspace(50, len(whole) - 40, 9).astype(int):
        broken = bytearray(whole)
        broken[place] ^= 0xFF
        path.write_bytes(bytes(broken))
        with pytest.raises(DataError, match=r"a\.png is damaged .*checksum"):
            imaging.read_image(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("statement", "code", "output"),
    [
        ("import slow", 130, ""),
        ("os.kill(os.getpid(), signal.SIGINT)", 0, "in order\n"),
        ("os.kill(os.getpid(), signal.SIGTERM)", 0, "in order\n"),
    ],
)
def test_ctrl_c_ends_an_import_at_once_and_everything_else_in_order(
    tmp_path: Path, statement: str, code: int, output: str
) -> None:
    """An exception in the middle of importing torch would abort the process with a core dump."""
    (tmp_path / "slow.py").write_text(
        "import os, signal\ntry:\n os.kill(os.getpid(), signal.SIGINT)\nfinally:\n print('no')"
    )
    program = (
        "import os, signal\nfrom gsdmsr_cli.cli.main import ctrl_c_that_spares_imports\n"
        # a process in the background of a shell script begins with SIGINT ignored
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"with ctrl_c_that_spares_imports():\n  try:\n    {statement}\n"
        "  except KeyboardInterrupt:\n    print('in order')\n"
        "assert signal.getsignal(signal.SIGINT) is signal.default_int_handler\n"
        "assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL"
    )
    call = [sys.executable, "-c", program]
    done = subprocess.run(
        call, cwd=tmp_path, capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stdout + done.stderr) == (code, output)
