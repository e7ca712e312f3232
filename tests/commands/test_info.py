"""gsdmsr info: what lies at a path, and whether it is sound."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from datasets import noise, write_dnerf, write_json, write_picture
from reports import small_report
from training_checks import begun_run

from gsdmsr_cli.commands import info
from gsdmsr_cli.exports._ply import write_ply
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.runs.run import Run
from gsdmsr_cli.scene.native import cv2

Capture = pytest.CaptureFixture[str]


def answer(path: Path, capsys: Capture) -> dict[str, Any]:
    """Return what the command says of something that is sound."""
    with say.on_its_own(as_json=True):
        info.run(path)
    document = json.loads(capsys.readouterr().out)
    assert document["path"] == str(path) and document["sound"] and document["problems"] == []
    assert isinstance(document["facts"], dict)
    return {"kind": document["kind"], **document["facts"]}


def problems(path: Path, capsys: Capture) -> list[str]:
    """Return what the command says is wrong with something."""
    with say.on_its_own(as_json=True), pytest.raises(DataError, match="is not sound") as caught:
        info.run(path)
    document = json.loads(capsys.readouterr().out)
    assert not document["sound"] and "\n" not in str(caught.value)
    found = document["problems"]
    assert isinstance(found, list) and found[0] in str(caught.value)
    return found


def encode(path: Path, frames: int) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, (64, 48))
    for i in range(frames):
        writer.write(np.full((48, 64, 3), 20 * i, np.uint8))
    writer.release()
    return path


def splats(count: int, degree: int = 1) -> Splats:
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": ()}
    rng = torch.Generator().manual_seed(0)
    shapes["sh"] = ((degree + 1) ** 2, 3)
    return Splats(**{n: torch.randn(count, *shape, generator=rng) for n, shape in shapes.items()})


def test_a_scene(tmp_path: Path, capsys: Capture) -> None:
    found = answer(write_dnerf(tmp_path / "scene"), capsys)
    assert found["kind"] == "scene" and found["layout"] == "dnerf"
    assert found["pictures"] == {"train": 3, "val": 2, "test": 2}
    assert (found["size"], found["times"], found["moments"]) == ([10, 8], [0, 1], 3)
    assert (found["preset"], found["bound"], found["points"]) == ("dnerf", 1.3, 0)


def test_a_scene_that_lacks_a_picture(tmp_path: Path, capsys: Capture) -> None:
    folder = write_dnerf(tmp_path / "scene")
    (folder / "train" / "r_001.png").unlink()
    assert "r_001" in problems(folder, capsys)[0]


def test_a_rig_whose_videos_are_not_decoded_is_left_as_it_is(
    tmp_path: Path, capsys: Capture
) -> None:
    encode(tmp_path / "cam00.mp4", 3)
    np.save(tmp_path / "poses_bounds.npy", np.ones((1, 17)))
    before = sorted(tmp_path.rglob("*"))
    assert "decoded by the first command" in answer(tmp_path, capsys)["frames"]
    assert sorted(tmp_path.rglob("*")) == before


@pytest.fixture
def run(tiny_scene: Path, tmp_path: Path) -> Run:
    """A run that has just begun."""
    data = Path(shutil.copytree(tiny_scene, tmp_path / "data"))
    options = "splats.count=60", "training.threads=1"
    made = begun_run(data, tmp_path / "run", options, reason="why")
    made.log({"step": 0, "val_psnr": 12.5})
    return made


def test_a_run(run: Run, capsys: Capture) -> None:
    found = answer(run.root, capsys)
    assert (found["kind"], found["preset"], found["preset_reason"]) == ("run", "dnerf", "why")
    assert (found["motion"], found["step"], found["complete"]) == ("control_points", 0, False)
    assert found["splats"] == 60 and found["val_psnr"] == 12.5
    assert found["checkpoint_bytes"] == run.checkpoint_path.stat().st_size
    assert found["data_is_there"] is True and found["layout"] == "dnerf"
    shutil.move(run.data, run.data.with_name("elsewhere"))
    assert answer(run.root, capsys)["data_is_there"] is False  # `--data` says where it is


def test_a_run_with_other_data_and_a_damaged_checkpoint(run: Run, capsys: Capture) -> None:
    path = run.data / "transforms_train.json"
    document = json.loads(path.read_text())
    write_json(path, document | {"camera_angle_x": 0.5})
    run.checkpoint_path.write_bytes(run.checkpoint_path.read_bytes()[:500])
    checkpoint, data = problems(run.root, capsys)
    assert "damaged checkpoint" in checkpoint and "is not the data that" in data


def test_a_video_and_one_cut_short(tmp_path: Path, capsys: Capture) -> None:
    path = encode(tmp_path / "a.mp4", 10)
    found = answer(path, capsys)
    assert (found["kind"], found["frames"], found["size"]) == ("video", 10, [64, 48])
    assert found["frames_a_second"] == 25 and found["bytes"] == path.stat().st_size
    path.write_bytes(path.read_bytes()[:300])
    assert "no video stream" in problems(path, capsys)[0]


def test_folders_of_pictures_and_of_videos(tmp_path: Path, capsys: Capture) -> None:
    for i in range(3):
        write_picture(tmp_path / "p" / f"{i}.png", noise(8, 10 + i // 2, seed=i))
    found = answer(tmp_path / "p", capsys)
    assert (found["kind"], found["pictures"]) == ("folder of pictures", 3)
    assert found["sizes"] == {"10 x 8": 2, "11 x 8": 1}
    (tmp_path / "p" / "1.png").write_bytes(b"no picture")
    assert "1.png" in problems(tmp_path / "p", capsys)[0]
    (tmp_path / "v").mkdir()
    encode(tmp_path / "v" / "a.mp4", 4)
    assert answer(tmp_path / "v", capsys)["videos"]["a.mp4"]["frames"] == 4


def test_splats_and_a_sequence_of_them(tmp_path: Path, capsys: Capture) -> None:
    for i in (1, 2, 3):
        write_ply(tmp_path / "s" / f"frame{i:04d}.ply", splats(4 + i, 2))
    found = answer(tmp_path / "s" / "frame0001.ply", capsys)
    assert (found["kind"], found["splats"], found["sh_degree"]) == ("splats", 5, 2)
    found = answer(tmp_path / "s", capsys)
    assert (found["kind"], found["files"]) == ("PLY sequence", 3)
    assert found["splats_from_to"] == [5, 7]
    (tmp_path / "s" / "frame0002.ply").unlink()
    assert "1 files of the sequence are missing" in problems(tmp_path / "s", capsys)[0]
    path = tmp_path / "s" / "frame0001.ply"
    path.write_bytes(path.read_bytes()[:-3])
    assert "frame0001.ply" in problems(path, capsys)[0]
    nan = bytearray((tmp_path / "s" / "frame0003.ply").read_bytes())
    nan[-4:] = np.float32("nan").tobytes()
    path.write_bytes(nan)
    assert "NaN or infinite" in problems(path, capsys)[0]


def test_a_report_of_eval(tmp_path: Path, capsys: Capture) -> None:
    write_json(tmp_path / "metrics.json", small_report())
    found = answer(tmp_path / "metrics.json", capsys)
    assert (found["kind"], found["psnr"], found["lpips_alex"]) == (
        "report of eval", 26.123456, None,
    )  # fmt: skip
    assert found["ms_ssim"] == 0.95 and found["resolution"] == [200, 160]
    write_json(tmp_path / "metrics.json", {"schema": 1})
    assert "not a report of eval" in problems(tmp_path / "metrics.json", capsys)[0]


def test_people_get_a_table(tmp_path: Path, capsys: Capture) -> None:
    folder = write_dnerf(tmp_path / "a [b] scene")
    info.run(folder)
    first, *rest = capsys.readouterr().out.splitlines()
    assert first == f"{folder}: scene, sound"
    assert any("train 3, val 2, test 2" in line for line in rest)


@pytest.mark.parametrize("name", ["missing", "empty", "notes.txt"])
def test_what_is_nothing_known_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").touch()
    with pytest.raises(DataError, match="a run, a scene, a video"):
        info.run(tmp_path / name)
