"""What is fuzzed: every place where the program reads what somebody else has written.

A target has a small valid input, a way to damage it, and what reads it. Inputs that belong to a
folder take the place of their file there for as long as they are read.
"""

from __future__ import annotations

import io
import json
import struct
import sys
from collections.abc import Callable
from contextlib import redirect_stderr
from dataclasses import dataclass
from functools import partial
from itertools import chain, pairwise
from pathlib import Path

import mutations
import numpy as np
import torch
from mutations import Mutation

sys.path.insert(0, str(Path(__file__).parents[1]))  # where the script of the long run is started

from datasets import noise, pose, write_dnerf, write_json, write_picture

from gsdmsr_cli.capture.exif import read_exif
from gsdmsr_cli.evaluation import lpips
from gsdmsr_cli.evaluation.gates import read_gates
from gsdmsr_cli.evaluation.lpips_trunks import ARCHITECTURES
from gsdmsr_cli.evaluation.request import Demands
from gsdmsr_cli.exports import _ply
from gsdmsr_cli.formats import _points, read_scene
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.building import start_model
from gsdmsr_cli.model.layer import Facts
from gsdmsr_cli.moving.quick import quick_file
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.paths import _keyframes
from gsdmsr_cli.runs import moving_file
from gsdmsr_cli.runs.beginning import create_run
from gsdmsr_cli.runs.checkpoints import Checkpoint
from gsdmsr_cli.runs.run import open_run
from gsdmsr_cli.scene import imaging
from gsdmsr_cli.scene.native import cv2
from gsdmsr_cli.scene.picture_files import IN_CAPTURES
from gsdmsr_cli.scene.video import read_video, video_length

Read = Callable[[Path], object]
"""Reads a file."""


@dataclass(frozen=True)
class Target:
    """One entry point.

    Attributes:
        name: of it.
        path: where an input is written before it is read.
        mutate: returns a damaged input.
        read: what is fuzzed.
        weight: how many inputs it gets, compared with others.
    """

    name: str
    path: Path
    mutate: Mutation
    read: Read
    weight: float = 1.0


def targets(folder: Path) -> list[Target]:
    """Return all targets, whose valid files are written below ``folder``."""
    makers = (
        _dnerf, _nerfstudio, _nerfies, _panoptic, _neural3d, _colmap, _points_files, _pictures,
        _videos, _options, _runs, _reports, _films, _weights,
    )  # fmt: skip
    found = [target for make in makers for target in make(folder)]
    assert len({target.name for target in found}) == len(found)
    return found


def _within(folder: Path, layout: str, files: dict[str, Callable[..., Mutation]]) -> list[Target]:
    """Return a target for each of the files of a scene, which is read as a whole."""
    read_scene(folder)
    return [
        Target(
            f"{layout}: {name}",
            folder / name,
            mutate((folder / name).read_bytes()),
            lambda _: read_scene(folder),
            weight=0.6,
        )
        for name, mutate in files.items()
    ]


def _dnerf(folder: Path) -> list[Target]:
    scene = write_dnerf(folder / "dnerf", train=2, val=0, test=1)
    files = {"transforms_train.json": mutations.document, "train/r_000.png": mutations.png}
    return _within(scene, "dnerf", files)


def _nerfstudio(folder: Path) -> list[Target]:
    scene = folder / "nerfstudio"
    frames = []
    for i in range(2):
        write_picture(scene / f"images/{i}.png", noise(8, 10, 3))
        write_picture(scene / f"masks/{i}.png", noise(8, 10, 1))
        names = {"file_path": f"images/{i}.png", "mask_path": f"masks/{i}.png", "time": float(i)}
        frames.append(names | {"transform_matrix": pose(0.5 * i)})
    camera = {"camera_model": "OPENCV", "fl_x": 9.0, "fl_y": 9.5, "cx": 5, "cy": 4, "w": 10, "h": 8}
    lens = {"k1": 0.1, "k2": 0.0, "p1": 0.001, "p2": 0.0, "ply_file_path": "points.ply"}
    splits = {"train_filenames": ["images/0.png"], "test_filenames": ["images/1.png"]}
    write_json(scene / "transforms.json", camera | lens | splits | {"frames": frames})
    write_json(scene / "scene.json", {"gsdmsr": "0.2", "bound": 2.0, "duration": 3.5})
    (scene / "points.ply").write_bytes(_ply_text())
    files = {
        "transforms.json": mutations.document,
        "scene.json": mutations.document,
        "points.ply": mutations.words,
    }
    return _within(scene, "nerfstudio", files)


def _nerfies(folder: Path) -> list[Target]:
    scene, ids = folder / "nerfies", ["000001", "000002"]
    write_json(scene / "dataset.json", {"ids": ids, "train_ids": ids[:1], "val_ids": ids[1:]})
    write_json(
        scene / "metadata.json", {n: {"warp_id": i, "time_id": i} for i, n in enumerate(ids)}
    )
    write_json(scene / "scene.json", {"near": 0.1, "far": 2.0, "scale": 0.5, "center": [0, 0, 0]})
    camera = {
        "orientation": np.eye(3).tolist(), "position": [0.0, 0.0, -3.0], "focal_length": 9.0,
        "principal_point": [5.0, 4.0], "skew": 0.0, "pixel_aspect_ratio": 1.0,
        "radial_distortion": [0.1, 0.0, 0.0], "tangential_distortion": [0.0, 0.0],
        "image_size": [10, 8],
    }  # fmt: skip
    for name in ids:
        write_json(scene / f"camera/{name}.json", camera)
        write_picture(scene / f"rgb/2x/{name}.png", noise(8, 10, 3))
    np.save(scene / "points.npy", np.random.default_rng(0).normal(size=(30, 3)).astype("f4"))
    files = {
        "dataset.json": mutations.document,
        "metadata.json": mutations.document,
        "scene.json": mutations.document,
        "camera/000001.json": mutations.document,
        "points.npy": mutations.raw,
    }
    return _within(scene, "nerfies", files)


def _panoptic(folder: Path) -> list[Target]:
    scene = folder / "panoptic"
    names = [[f"{c}/{t}.png" for c in range(2)] for t in range(2)]
    pinhole = [[9.0, 0.0, 5.0], [0.0, 9.0, 4.0], [0.0, 0.0, 1.0]]
    at = np.eye(4)
    at[2, 3] = 4.0
    many = {"fn": names, "k": [[pinhole] * 2] * 2, "w2c": [[at.tolist()] * 2] * 2}
    write_json(scene / "train_meta.json", {"w": 10, "h": 8} | many)
    for name in chain.from_iterable(names):
        write_picture(scene / "ims" / name, noise(8, 10, 3))
        write_picture(scene / "seg" / name, noise(8, 10, 1))
    np.savez(scene / "init_pt_cld.npz", data=np.random.default_rng(0).random((30, 7)))
    files = {"train_meta.json": mutations.document, "init_pt_cld.npz": mutations.zipped}
    return _within(scene, "panoptic", files)


def _neural3d(folder: Path) -> list[Target]:
    scene = folder / "neural3d"
    for c in range(2):
        for i in range(2):
            write_picture(scene / f"cam{c:02d}/images/{i:04d}.png", noise(8, 10, 3))
    right, down, back = [1.0, 0, 0], [0, 1.0, 0], [0, 0, -1.0]
    tables = [np.stack([down, right, back, [c, 0, 0], [8, 10, 9.0]], axis=1) for c in range(2)]
    np.save(scene / "poses_bounds.npy", [[*table.ravel(), 1.0, 16.0] for table in tables])
    return _within(scene, "neural3d", {"poses_bounds.npy": mutations.raw})


def _colmap(folder: Path) -> list[Target]:
    found = []
    for layout, mutate in (("bin", mutations.raw), ("txt", mutations.words)):
        scene = folder / f"colmap-{layout}"
        for i in range(2):
            write_picture(scene / f"images/{i}.png", noise(8, 10, 3))
        for name, content in (_colmap_bytes() if layout == "bin" else _colmap_text()).items():
            path = scene / f"sparse/0/{name}.{layout}"
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        names = ("cameras", "images", "points3D")
        files = {f"sparse/0/{name}.{layout}": mutate for name in names}
        found += _within(scene, "colmap", files)
    return found


def _colmap_bytes() -> dict[str, bytes]:
    cameras = struct.pack("<QiiQQ8d", 1, 7, 4, 10, 8, 9, 9, 5, 4, 0.1, 0, 0.001, 0)
    images, points = struct.pack("<Q", 2), struct.pack("<Q", 25)
    for i in range(2):
        images += struct.pack("<i7di", i + 1, 1, 0, 0, 0, 0.1 * i, 0, 4, 7)
        images += f"{i}.png".encode() + b"\0" + struct.pack("<Qddq", 1, 1.0, 2.0, -1)
    for i in range(25):
        points += struct.pack("<Q3d3BdQii", i, i % 5 - 2, i / 9 - 1, 0, 255, 9, i, 0.5, 1, 1, 2)
    return {"cameras": cameras, "images": images, "points3D": points}


def _colmap_text() -> dict[str, bytes]:
    rows = [f"{i} {i % 5 - 2} {i / 9 - 1} 0 255 9 {i} 0.5 1 2" for i in range(25)]
    return {
        "cameras": b"# Cameras\n7 OPENCV 10 8 9 9 5 4 0.1 0 0.001 0\n",
        "images": b"# Images\n1 1 0 0 0 0 0 4 7 0.png\n1 2 -1\n2 1 0 0 0 0.1 0 4 7 1.png\n\n",
        "points3D": "\n".join(rows).encode(),
    }


def _ply_text() -> bytes:
    names = [f"property float {axis}" for axis in "xyz"]
    names += [f"property uchar {name}" for name in ("red", "green", "blue")]
    head = ["ply", "format ascii 1.0", "element vertex 3", *names, "end_header"]
    return "\n".join([*head, "1 2 3 4 5 6", "2 3 4 5 6 7", "-1 0.5 1e3 0 255 9", ""]).encode()


def _ply_bytes() -> bytes:
    head = _ply_text().partition(b"end_header\n")[0].replace(b"ascii", b"binary_little_endian")
    return head + b"end_header\n" + struct.pack("<3f3B", 1, 2, 3, 4, 5, 6) * 3


def _points_files(folder: Path) -> list[Target]:
    generator = torch.Generator().manual_seed(0)
    splats = _splats(generator, harmonics=4)
    _ply.write_ply(folder / "export.ply", splats)
    export = (folder / "export.ply").read_bytes()
    return [
        Target("ply: ascii", folder / "a.ply", mutations.words(_ply_text()), _points.read_ply, 4),
        Target("ply: binary", folder / "b.ply", mutations.raw(_ply_bytes()), _points.read_ply, 4),
        Target("export: splats", folder / "export.ply", _either(export), _ply.read_ply, 4),
    ]


def _either(seed: bytes) -> Mutation:
    """Return what damages a file of text and numbers as the one or the other."""
    both = mutations.raw(seed), mutations.words(seed)
    return lambda random: random.choice(both)(random)


def _splats(generator: torch.Generator, harmonics: int = 1, count: int = 3) -> Splats:
    return Splats(
        means=torch.randn(count, 3, generator=generator),
        quats=torch.randn(count, 4, generator=generator),
        log_scales=torch.randn(count, 3, generator=generator),
        logit_opacities=torch.randn(count, generator=generator),
        sh=torch.randn(count, harmonics, 3, generator=generator),
    )


def _pictures(folder: Path) -> list[Target]:
    def encoded(suffix: str, channels: int = 3) -> bytes:
        return cv2.imencode(suffix, noise(8, 10, channels))[1].tobytes()

    def read(path: Path) -> None:
        imaging.image_size(path)
        imaging.read_image(path)

    jpeg = encoded(".jpg")
    imaging.write_exr(folder / "a.exr", noise(6, 5, 1).astype(np.float32), ("Z",))
    others = [encoded(suffix) for suffix in (".tiff", ".bmp", ".webp")]
    pngs = [encoded(".png", channels) for channels in (1, 3, 4)]
    with_exif = jpeg[:2] + _exif() + jpeg[2:]
    return [
        Target("picture: PNG", folder / "a.png", mutations.png(*pngs), read, weight=5),
        Target("picture: JPEG", folder / "a.jpg", mutations.raw(jpeg, with_exif), read, weight=5),
        Target(
            "picture: EXR", folder / "a.exr", mutations.raw((folder / "a.exr").read_bytes()),
            imaging.read_exr, weight=3,
        ),
        Target("picture: EXIF", folder / "exif.jpg", mutations.raw(with_exif), read_exif, weight=4),
        Target(
            "picture: of a capture", folder / "a.bin", mutations.raw(*others),
            partial(imaging.read_image, kinds=IN_CAPTURES), weight=2,
        ),
    ]  # fmt: skip


def _directory(rows: list[tuple[int, int, int, int]]) -> bytes:
    """Return a directory of TIFF: tags, their types, counts and values or places."""
    return struct.pack("<H", len(rows)) + b"".join(struct.pack("<HHII", *row) for row in rows)


def _exif() -> bytes:
    """Return the part of a JPEG file that says how and when it was taken."""
    text = b"2026:01:02 03:04:05\0"
    own = [(0x9003, 2, len(text), 64), (0x9291, 2, 3, int.from_bytes(b"25\0", "little")),
           (0xA405, 3, 1, 28)]  # fmt: skip
    main = [(0x0112, 3, 1, 6), (0x8769, 4, 1, 26 + 12)]
    tiff = b"II*\0" + struct.pack("<I", 8) + _directory(main) + struct.pack("<I", 0)
    tiff += _directory([(tag, kind, count, at if tag != 0x9003 else len(tiff) + 42)
                  for tag, kind, count, at in own]) + struct.pack("<I", 0) + text  # fmt: skip
    content = b"Exif\0\0" + tiff
    return b"\xff\xe1" + struct.pack(">H", len(content) + 2) + content


def _videos(folder: Path) -> list[Target]:
    def read(path: Path) -> None:
        video_length(path)
        times = [time for time, _ in read_video(path)]
        assert all(later > time for time, later in pairwise(times))

    found = []
    for suffix, codec in ((".mp4", "mp4v"), (".webm", "VP90")):
        path = folder / f"film{suffix}"
        writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 10.0, (32, 16))
        for i in range(4):
            writer.write(noise(16, 32, 3, seed=i))
        writer.release()
        mutate = mutations.raw(path.read_bytes())
        found.append(Target(f"video: {suffix[1:]}", path, mutate, read, weight=2))
    return found


_PRESET = b"""base: default
training: {steps: 500, precision: float32, budget: 90s}
motion:
  name: hexplane
  levels: [2, 4]
density: {cap: 1000, every: 100}
events: [density, {name: opacity_reset}]
data: {background: white, cache_mib: 64}
"""


def _options(folder: Path) -> list[Target]:
    def preset(path: Path) -> None:
        with redirect_stderr(io.StringIO()):  # hints at names of earlier versions
            load_preset(None, path, [])

    def override(path: Path) -> None:
        with redirect_stderr(io.StringIO()):
            load_preset(None, None, [path.read_bytes().decode(errors="surrogateescape")])

    texts = [b"training.steps=500", b"motion={name: hexplane, levels: [2, 4]}", b"data.cache_mib=9",
             b"events=[density, {name: thinning}]", b"training.budget=8m"]  # fmt: skip
    return [
        Target("options: preset", folder / "own.yaml", mutations.words(_PRESET), preset, 0.2),
        Target("options: --set", folder / "override", mutations.words(*texts), override, 0.3),
    ]


def _runs(folder: Path) -> list[Target]:
    data = read_scene(write_dnerf(folder / "run-data", train=2, val=1, test=1))
    preset = load_preset("dnerf", None, ["motion={name: control_points, count: 4, neighbours: 2}"])
    splats = _splats(torch.Generator().manual_seed(0), count=8)
    facts = Facts(bound=1.3, box=((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0)), frames=2)
    model = start_model(splats, preset.motion, preset.layers, facts, torch.Generator())
    run = create_run(folder / "run", "dnerf", preset, facts, data)
    run.save(Checkpoint(10, 0.1, 2.5, dict(model.tensors()), {"adam_steps": {}, "events": {}}))
    run.log({"step": 10, "psnr": 20.5})
    run.log({"step": 20, "psnr": 21.5})

    def read_log(path: Path) -> None:
        open_run(path.parent).read_log()

    def load(path: Path) -> None:
        open_run(path.parent).load_model()

    described = folder / "a.dsplat"
    header = {"scene": {}, "about": run.about() | {"step": 10, "progress": 0.1}}
    described.write_bytes(quick_file(model, 2, facts.bound, header))

    def play(path: Path) -> None:
        open_run(path)
        played, _ = moving_file.load(path)
        played.at(played.instant(0.3))

    files = {
        "run.json": (mutations.document, lambda path: open_run(path.parent), 0.8),
        "checkpoint.safetensors": (mutations.safetensors, load, 0.3),
        "metrics.jsonl": (mutations.words, read_log, 0.5),
    }
    moving = mutations.headed(described.read_bytes())
    return [
        Target("run: .dsplat", described, moving, play, 2),
        *(
            Target(
                f"run: {name}",
                run.root / name,
                mutate((run.root / name).read_bytes()),
                read,
                weight,
            )
            for name, (mutate, read, weight) in files.items()
        ),
    ]


def _reports(folder: Path) -> list[Target]:
    conventions = {"ssim": "gaussian 11"}
    protocol = {"split": "test", "resolution": [10, 8], "background": "white",
                "data_fingerprint": "0123", "conventions": conventions}  # fmt: skip
    missing = {"value": None, "reason": "no weights", "searched": []}
    aggregate = {"psnr": 25.5, "ssim": 0.9, "lpips_alex": {"value": 0.1}, "lpips_vgg": missing}
    report = {"schema": 1, "protocol": protocol, "aggregate": aggregate}

    def baseline(path: Path) -> None:
        read_gates(Demands(baseline=path)).judge(report)

    def threshold(path: Path) -> None:
        text = path.read_bytes().decode(errors="surrogateescape")
        read_gates(Demands(fail_under=(text,))).judge(report)
        read_gates(Demands(fail_over=(text,))).judge(report)

    texts = b"psnr=25", b"ssim=0.9", b"lpips_alex=0.1"
    seed = json.dumps(report).encode()
    return [
        Target("gates: baseline", folder / "metrics.json", mutations.document(seed), baseline, 3),
        Target("gates: threshold", folder / "threshold", mutations.words(*texts), threshold, 3),
    ]


def _films(folder: Path) -> list[Target]:
    scene = read_scene(write_dnerf(folder / "film-data", train=2, val=1, test=1))
    own = {"position": [3, 0, 1], "look_at": [0, 0, 0.2], "time": 1, "up": [0, 0, 1], "at": 2.0}
    keys = [{"view": "train/r_000", "time": 0.2, "at": 0.0}, own | {"field_of_view": 40}]
    seed = json.dumps({"keyframes": keys, "frames": 5, "fps": 12}).encode()

    def read(path: Path) -> None:
        _keyframes.film(scene, path, None, None)

    return [Target("film: keyframes", folder / "tour.json", mutations.document(seed), read)]


def _weights(folder: Path) -> list[Target]:
    channels = ARCHITECTURES["squeeze"].channels
    tensors = {f"lin{i}.model.1.weight": torch.rand(1, c, 1, 1) for i, c in enumerate(channels)}
    seeds = []
    for zipped in (True, False):
        file = io.BytesIO()
        torch.save(tensors, file, _use_new_zipfile_serialization=zipped)
        seeds.append(file.getvalue())

    def read(path: Path) -> None:
        lpips._load_linear(path, channels)

    return [
        Target("weights: ZIP", folder / "a.pth", mutations.zipped(seeds[0]), read),
        Target("weights: earlier", folder / "b.pth", mutations.raw(seeds[1]), read),
    ]
