"""The pictures of README and docs: small, shown somewhere, and made again by their script."""

from __future__ import annotations

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from chromium import Chromium
from PIL import Image
from training_checks import begun_run

from gsdmsr_cli.commands import eval as evaluate
from gsdmsr_cli.evaluation.request import Output
from gsdmsr_cli.scene.imaging import image_size

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "docs" / "pictures"
PICTURES = sorted(FOLDER.glob("*.webp"))
FEW = ("splats.count=200", "splats.start=box", "splats.opacity=0.5", "training.static_until=0")

MOST_BYTES = {"moving.webp": 400_000}
"""Of a picture; of others 150,000."""


@pytest.fixture(scope="module")
def make() -> ModuleType:
    """The script, with films of few small frames."""
    spec = importlib.util.spec_from_file_location("make_pictures", FOLDER / "make.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.PATHS = "orbit", "still"
    module.MOVING_FRAMES = module.PATH_FRAMES = 3
    module.MOVING_SIZE = module.PATH_SIZE = 24
    return module


@pytest.fixture(scope="module")
def run(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of no step, evaluated."""
    root = begun_run(tiny_scene, tmp_path_factory.mktemp("pictures") / "run", FEW).root
    evaluate.run(root, output=Output(report=True, play=True))
    return root


@pytest.mark.parametrize("path", PICTURES, ids=lambda path: path.name)
def test_every_picture_is_small_and_shown(path: Path) -> None:
    assert path.stat().st_size <= MOST_BYTES.get(path.name, 150_000)
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    shown = [
        page
        for page in pages
        for target in re.findall(r"!\[[^\]]+\]\(([^)]+)\)", page.read_text(encoding="utf-8"))
        if (page.parent / target).resolve() == path
    ]
    assert shown


def test_readme_begins_with_a_picture_that_moves() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert 0 < text.index("](docs/pictures/moving.webp)") < text.index("\n## ")
    with Image.open(FOLDER / "moving.webp") as picture:
        assert picture.n_frames > 20 and picture.info["loop"] == 0


def test_films_become_pictures_that_move(make: ModuleType, run: Path, tmp_path: Path) -> None:
    make.moving(run, tmp_path)
    make.paths(run, tmp_path)
    for name, width in (("moving.webp", 24), ("paths.webp", 48)):
        with Image.open(tmp_path / name) as picture:
            assert (picture.n_frames, picture.size) == (3, (width, 24))


def test_pages_become_pictures(
    make: ModuleType, browser: Chromium, run: Path, tmp_path: Path
) -> None:
    make.report(browser, run, tmp_path)
    make.player(browser, run, tmp_path)
    make.view(browser, run, tmp_path)
    for name in ("report.webp", "player.webp", "view.webp"):
        with Image.open(tmp_path / name) as picture:
            pixels = np.asarray(picture.convert("RGB"))
        assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 100, name


def test_a_capture_shows_one_thing_that_moves(make: ModuleType, tmp_path: Path) -> None:
    make.write_capture(tmp_path / "capture", 3, 20)
    files = sorted((tmp_path / "capture").iterdir())
    assert [path.name for path in files] == ["0000.png", "0001.png", "0002.png"]
    assert image_size(files[0]) == (20, 20)
