"""One scene in every layout: each is trained on, scored and filmed as it is."""

from __future__ import annotations

import json
import shutil
import struct
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
import torch
from datasets import write_json, write_picture

from gsdmsr_cli.cli.main import main
from gsdmsr_cli.evaluation import speed
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.scene.imaging import composite, read_image
from gsdmsr_cli.scene.scene import Scene, View

STEPS = 80

SETTINGS = (
    "splats.count=400", "splats.start=surfaces", "training.static_until=0.2", "density.start=10",
    "density.every=10", "density.gradient=1e-4", "density.cap=600", "data.background=white",
)  # fmt: skip


def opaque(view: View) -> np.ndarray:
    over_white = composite(read_image(view.image_path), (1.0, 1.0, 1.0))
    return np.rint(over_white * 255).astype(np.uint8)


def by_name(scene: Scene) -> list[tuple[str, View]]:
    """Return train and test views with names whose last numbers are in the order of time."""
    views = [view for view in scene.views if view.split != "val"]
    return [(f"{round(1000 * view.time):04d}_{i:03d}", view) for i, view in enumerate(views)]


def as_nerfies(scene: Scene, folder: Path) -> None:
    named = by_name(scene)
    splits: dict[str, list[str]] = {"train": [], "test": []}
    for name, view in named:
        splits[view.split].append(name)
        write_picture(folder / "rgb" / "1x" / f"{name}.png", opaque(view))
        camera = view.camera
        write_json(
            folder / "camera" / f"{name}.json",
            {
                "orientation": camera.rotation.tolist(),
                "position": (7 * camera.centre + [1, 2, 3]).tolist(),  # a world of its own
                "focal_length": camera.fx,
                "principal_point": [camera.cx, camera.cy],
                "image_size": [camera.width, camera.height],
            },
        )
    ids = [name for name, _ in named]
    lists = {"ids": ids, "train_ids": splits["train"], "val_ids": splits["test"]}
    write_json(folder / "dataset.json", lists)
    times = {name: {"warp_id": round(1000 * view.time)} for name, view in named}
    write_json(folder / "metadata.json", times)


def as_nerfstudio(scene: Scene, folder: Path) -> None:
    frames: list[dict[str, Any]] = []
    lists: dict[str, list[str]] = {"train_filenames": [], "test_filenames": []}
    for name, view in by_name(scene):
        write_picture(folder / "images" / f"{name}.png", opaque(view))
        pose = np.linalg.inv(view.camera.world_to_camera) @ np.diag([1.0, -1, -1, 1])
        entry = {"file_path": f"images/{name}.png", "time": view.time}
        frames.append(entry | {"transform_matrix": pose.tolist()})
        lists[f"{view.split}_filenames"].append(entry["file_path"])
    camera = scene.views[0].camera
    document = {"fl_x": camera.fx, "cx": camera.cx, "cy": camera.cy, "frames": frames, **lists}
    write_json(folder / "transforms.json", document)


def as_panoptic(scene: Scene, folder: Path) -> None:
    """Each moment has one camera, but no camera more than one moment; so moments are by split."""
    for split in ("train", "test"):
        views = sorted(scene.split(split), key=lambda view: view.time)
        camera = views[0].camera
        k = [[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]
        document = {
            "w": camera.width,
            "h": camera.height,
            "fn": [[f"{split}/{i:06d}.png"] for i in range(len(views))],
            "k": [[k]] * len(views),
            "w2c": [[view.camera.world_to_camera.tolist()] for view in views],
        }
        write_json(folder / f"{split}_meta.json", document)
        for (name,), view in zip(document["fn"], views, strict=True):
            write_picture(folder / "ims" / name, opaque(view))


def as_colmap(scene: Scene, folder: Path) -> None:
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    camera = scene.views[0].camera
    size = struct.pack("<QQ", camera.width, camera.height)
    parameters = struct.pack("<3d", camera.fx, camera.cx, camera.cy)
    (model / "cameras.bin").write_bytes(struct.pack("<Qii", 1, 1, 0) + size + parameters)
    content = b""
    views = sorted((v for v in scene.views if v.split != "val"), key=lambda view: view.time)
    for i, view in enumerate(views):
        write_picture(folder / "images" / f"{i:03d}.png", opaque(view))
        w2c = view.camera.world_to_camera
        content += struct.pack("<i4d", i, *quaternion(w2c[:3, :3])) + struct.pack(
            "<3d", *w2c[:3, 3]
        )
        content += struct.pack("<i", 1) + f"{i:03d}.png".encode() + b"\0" + bytes(8)
    (model / "images.bin").write_bytes(struct.pack("<Q", len(views)) + content)
    (model / "points3D.bin").write_bytes(bytes(8))


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """The eigenvector of Bar-Itzhack's matrix (2000), wxyz."""
    (a, b, c), (d, e, f), (g, h, i) = rotation
    k = [[a - e - i, 0, 0, 0], [d + b, e - a - i, 0, 0], [g + c, h + f, i - a - e, 0],
         [h - f, c - g, d - b, a + e + i]]  # fmt: skip
    x, y, z, w = np.linalg.eigh(np.array(k))[1][:, -1]
    return np.array([w, x, y, z])


LAYOUTS: dict[str, Callable[[Scene, Path], None]] = {
    "nerfies": as_nerfies,
    "nerfstudio": as_nerfstudio,
    "panoptic": as_panoptic,
    "colmap": as_colmap,
}


@pytest.fixture(autouse=True)
def as_before(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Threads as they were, and no weights of LPIPS, whatever this machine has."""
    monkeypatch.delenv("GSDMSR_LPIPS_DIR", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(speed, "SECONDS", 0.05)
    before = numba.get_num_threads(), torch.get_num_threads()
    yield
    numba.set_num_threads(before[0])
    torch.set_num_threads(before[1])


def gsdmsr(*arguments: object) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["gsdmsr", *map(str, arguments)])
        patch.setenv("GSDMSR_DEBUG", "1")
        with pytest.raises(SystemExit) as ended:
            main()
    assert ended.value.code == 0


@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_layout_is_trained_on_scored_and_filmed(
    tiny_scene: Path, tmp_path: Path, layout: str
) -> None:
    data, run = tmp_path / "data", tmp_path / "run"
    LAYOUTS[layout](read_scene(tiny_scene), data)
    scene = read_scene(data)
    assert scene.layout == layout
    assert np.isfinite(scene.bound) and 1 < scene.bound < 10
    options = [f"--set={setting}" for setting in SETTINGS]
    gsdmsr("train", "--data", data, "--out", run, "--preset", "gsdmsr", "--steps", STEPS, *options)
    gsdmsr("eval", run)
    gsdmsr("render", run, "--path", "test", "--video", "none")
    metrics = json.loads((run / "eval" / "metrics.json").read_text())
    # white pictures would score 10.5 dB, and cameras that do not fit to the pictures hardly more
    # pictures of the mean colour would score 10.7 dB; cameras that do not fit lead to little more
    assert metrics["aggregate"]["psnr"] > 13
    assert len(metrics["frames"]) == len(scene.split("test"))
    shutil.rmtree(run)
