"""Shared fixtures: where the real data lies, and why a test that needs it is skipped."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import cuda_shim
import pytest
from chromium import VARIABLE, Chromium, find_chromium
from datasets import write_picture

from gsdmsr_cli.backends.cuda import availability
from gsdmsr_cli.demo.synthetic import draw, solids_at, write_scene
from gsdmsr_cli.formats import read_scene


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real data named by GSDMSR_DATA."""
    value = os.environ.get("GSDMSR_DATA")
    if not value:
        pytest.skip("GSDMSR_DATA is not set: it names the folder of real data")
    folder = Path(value)
    if not folder.is_dir():
        pytest.skip(f"GSDMSR_DATA={value} is not a folder")
    return folder.resolve()


@pytest.fixture(scope="session")
def tiny_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a moving scene of 48 x 48 px in D-NeRF layout: 12 train, 3 val, 4 test views."""
    folder = tmp_path_factory.mktemp("data") / "tiny"
    write_scene(folder, size=48, train=12, val=3, test=4)
    return folder


@pytest.fixture
def rig(tiny_scene: Path, tmp_path: Path) -> Path:
    """The tiny scene seen by the first camera alone at all of its moments."""
    data = tmp_path / "rig"
    shutil.copytree(tiny_scene, data)
    layout = data / "transforms_train.json"
    document = json.loads(layout.read_text())
    camera = read_scene(data).split("train")[0].camera
    for frame in document["frames"]:
        frame["transform_matrix"] = document["frames"][0]["transform_matrix"]
        write_picture(data / f"{frame['file_path']}.png", draw(solids_at(frame["time"]), camera))
    layout.write_text(json.dumps(document))
    return data


@pytest.fixture(scope="session")
def _shim_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the CUDA kernels that have been built for the CPU in this session."""
    return tmp_path_factory.mktemp("shim")


@pytest.fixture(params=["cpu", "cuda"])
def place(request: pytest.FixtureRequest) -> str:
    """Where tensors lie that CUDA kernels run on: in the memory of the CPU, and of a GPU."""
    if request.param == "cuda":
        reason = availability.missing()
        if reason is not None:
            pytest.skip(reason)
    else:
        request.getfixturevalue("kernels_on_the_cpu")
    return str(request.param)


@pytest.fixture(scope="module")
def kernels_on_the_cpu(_shim_folder: Path) -> Iterator[cuda_shim.Shim]:
    """Let CUDA kernels run on tensors in the memory of the CPU."""
    if cuda_shim.MISSING:
        pytest.skip(cuda_shim.MISSING)
    with cuda_shim.on_the_cpu(_shim_folder) as shim:
        yield shim


@pytest.fixture(scope="session")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Chromium]:
    """A browser without a screen, which draws WebGL on the CPU."""
    binary = find_chromium()
    if binary is None:
        pytest.skip(f"no Chromium on the path; {VARIABLE} may name one")
    try:
        chromium = Chromium(binary, tmp_path_factory.mktemp("profile"))
    except OSError as error:
        pytest.skip(f"{binary} does not start: {error}")
    with chromium:
        yield chromium
