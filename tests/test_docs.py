"""The worked examples in docs/ run as they stand, and links and commands in the pages exist."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from datasets import noise, write_json, write_picture
from kernel_checks import generator

from gsdmsr_cli import formats, paths, plugins
from gsdmsr_cli import motion as motions
from gsdmsr_cli.errors import DataError, UsageError
from gsdmsr_cli.fields.planes import CUBE
from gsdmsr_cli.film import PathOptions
from gsdmsr_cli.formats import dnerf, read_scene
from gsdmsr_cli.model import Model, load_model
from gsdmsr_cli.motion import Facts, start_motion
from gsdmsr_cli.pictures import Pictures
from gsdmsr_cli.preset import load_preset
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.splats import Splats
from gsdmsr_cli.synthetic import write_scene
from gsdmsr_cli.training.trainer import Trainer

ROOT = Path(__file__).parent.parent
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])
COMMANDS = (
    "prepare", "train", "eval", "render", "export", "demo", "doctor", "weights", "benchmark",
)  # fmt: skip


def example(page: str) -> str:
    """Return the first block of Python in a page."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    found = re.search(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert found, page
    return found[1]


def installed(package: ModuleType, name: str, page: str, folder: Path) -> Iterator[ModuleType]:
    """Put the page's example into a package, as if its file lay there, and yield the module."""
    (folder / f"{name}.py").write_text(example(page), encoding="utf-8")
    package.__path__.append(str(folder))
    importlib.invalidate_caches()
    try:
        yield plugins.load(package.__name__, name)
    finally:
        package.__path__.remove(str(folder))
        sys.modules.pop(f"{package.__name__}.{name}", None)


@pytest.fixture
def linear(tmp_path: Path) -> Iterator[ModuleType]:
    yield from installed(motions, "linear", "adding-a-motion.md", tmp_path)


@pytest.fixture
def turntable(tmp_path: Path) -> Iterator[ModuleType]:
    yield from installed(formats, "turntable", "adding-a-format.md", tmp_path)


@pytest.fixture
def swing(tmp_path: Path) -> Iterator[ModuleType]:
    yield from installed(paths, "swing", "adding-a-path.md", tmp_path)


def test_the_example_of_a_path_swings(swing: ModuleType, tiny_scene: Path) -> None:
    scene = read_scene(tiny_scene)
    shots = paths.make_film(scene, "swing", PathOptions(9)).shots
    bearings = [np.arctan2(*shot.camera.centre[1::-1]) for shot in shots]
    turned = np.degrees(np.unwrap(bearings) - bearings[0])
    expected = 30 * np.sin(2 * np.pi * np.arange(9) / 8)
    np.testing.assert_allclose(turned, expected, atol=1e-6)
    assert [shot.time for shot in shots] == [i / 8 for i in range(9)]
    assert len(paths.make_film(scene, "swing", PathOptions()).shots) == 90
    with pytest.raises(UsageError, match="--view is not for --path swing"):
        paths.make_film(scene, "swing", PathOptions(views=("test/r_000",)))


def splats_of(count: int) -> Splats:
    rng = generator()
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": (), "sh": (1, 3)}
    return Splats(**{n: torch.randn(count, *shape, generator=rng) for n, shape in shapes.items()})


def started(settings: dict[str, Any], count: int) -> Any:
    return start_motion(settings, Facts(1.3, CUBE, 10), count, generator())


def test_the_example_of_a_motion_keeps_to_the_rules(linear: ModuleType) -> None:
    splats, motion = splats_of(5), started({"name": "linear"}, 5)
    assert torch.equal(motion.at(splats, 0.9).means, splats.means)
    with torch.no_grad():
        motion.velocities += torch.arange(15.0).reshape(5, 3)
    moved = motion.at(splats, 1.0)
    torch.testing.assert_close(moved.means, splats.means + 0.5 * motion.velocities)
    assert motion.penalty(splats, 0.5, torch.Generator()) > 0
    rows = torch.tensor([4, 0, 0])
    motion.take(rows)
    assert torch.equal(motion.at(splats.take(rows), 1.0).means, moved.means[rows])
    with pytest.raises(UsageError, match="slownes"):
        started({"name": "linear", "slownes": 1.0}, 5)


def test_the_example_of_a_motion_is_saved_and_loaded(linear: ModuleType) -> None:
    model = Model(splats_of(5), started({"name": "linear"}, 5))
    with torch.no_grad():
        model.tensors()["motion.velocities"].normal_(generator=generator())
    model.take(torch.tensor([1, 1, 3]))
    tensors = {name: tensor.detach().clone() for name, tensor in model.tensors().items()}
    loaded = load_model(tensors, {"name": "linear"}, Facts(1.3, CUBE, 10), 1.0)
    assert torch.equal(loaded.at(0.2).means, model.at(0.2).means)


def test_the_example_of_a_motion_trains_and_grows(linear: ModuleType, tmp_path: Path) -> None:
    data = tmp_path / "scene"
    write_scene(data, size=32, train=6, val=1, test=1)
    options = [
        "motion={name: linear}", "splats.count=150", "training.steps=40", "density.start=10",
        "density.every=10", "density.until=1.0", "density.gradient=1e-9", "density.cap=400",
        "density.reset_at=[]", "training.static_until=0.1",
    ]  # fmt: skip
    preset = load_preset("dnerf", None, options)
    pictures = Pictures((1.0, 1.0, 1.0), 1, 1 << 28)
    trainer = Trainer(dnerf.read(data), preset, best_engine("cpu"), pictures)
    losses = [trainer.step().loss for _ in range(40)]
    model = trainer.model
    assert np.isfinite(losses).all() and np.mean(losses[-6:]) < np.mean(losses[:6])
    assert 150 < len(model.splats) <= 400
    for name in ("splats.means", "motion.velocities"):
        tensor = model.tensors()[name]
        assert trainer.optimizer.first[name].shape == tensor.shape == (len(model.splats), 3)
    assert model.tensors()["motion.velocities"].any()


def write_turntable(folder: Path, count: int, **changes: Any) -> Path:
    for i in range(count):
        write_picture(folder / f"p{i}.png", noise(6, 8, seed=i))
    pictures = [f"p{i}.png" for i in range(count)]
    document = {"field_of_view": 40, "distance": 4, "elevation": 20, "pictures": pictures}
    write_json(folder / "turntable.json", document | changes)
    return folder


def test_the_example_of_a_format_is_read(turntable: ModuleType, tmp_path: Path) -> None:
    scene = read_scene(write_turntable(tmp_path / "data", 9))
    assert scene.layout == "turntable" and scene.bound == 2
    assert [view.split for view in scene.views] == 7 * ["train"] + ["test", "train"]
    assert [view.time for view in scene.views] == [i / 8 for i in range(9)]
    for view in scene.views:
        camera = view.camera
        assert np.linalg.norm(camera.centre) == pytest.approx(4)
        origin = camera.translation  # where the world's origin lies in the camera's axes
        assert origin == pytest.approx([0, 0, 4], abs=1e-9)
        assert camera.centre[2] == pytest.approx(4 * np.sin(np.radians(20)))
        assert camera.rotation[1] @ [0, 0, 1] < 0  # y is down
    assert scene.views[0].camera.fx == pytest.approx(4 / np.tan(np.radians(20)))
    picture = Pictures((1.0, 1.0, 1.0), 1, 1 << 20).load(scene.views[0])
    assert picture.shape == (3, 6, 8)


@pytest.mark.parametrize(
    "changes",
    [
        {"distance": -1},
        {"field_of_view": "wide"},
        {"elevation": 90},
        {"pictures": None},
        {"pictures": ["p0.png"]},
        {"pictures": ["p0.png", "../outside.png"]},
        {"pictures": ["p0.png", "missing.png"]},
    ],
    ids=str,
)
def test_the_example_of_a_format_refuses_what_it_cannot_use(
    turntable: ModuleType, tmp_path: Path, changes: dict[str, Any]
) -> None:
    with pytest.raises(DataError, match=r"turntable\.json") as caught:
        read_scene(write_turntable(tmp_path / "data", 2, **changes))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8")):
        if not re.match(r"[a-z]+:", target):
            assert (page.parent / target).exists(), target


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_paths_of_the_package_that_pages_name_exist(page: Path) -> None:
    examples = {f"gsdmsr_cli/{n}.py" for n in ("motion/linear", "formats/turntable", "paths/swing")}
    text = page.read_text(encoding="utf-8")
    for path in set(re.findall(r"\b(?:gsdmsr_cli|tests|presets)/[\w/]+\.(?:py|yaml)", text)):
        assert (ROOT / path).is_file() or path in examples | {"presets/linear.yaml"}, path


@pytest.mark.parametrize("command", COMMANDS)
def test_every_subcommand_has_a_page_that_names_its_options(command: str) -> None:
    from typer.main import get_command

    from gsdmsr_cli.cli import app

    group: Any = get_command(app)
    assert set(group.commands) == set(COMMANDS)
    text = (ROOT / "docs" / f"{command}.md").read_text(encoding="utf-8")
    entry = group.commands[command]
    entries = list(entry.commands.values()) if hasattr(entry, "commands") else [entry]
    options = [name for e in entries for p in e.params for name in p.opts if name[:2] == "--"]
    for option in options:
        assert option in text, option
    known = {"--help", *options}
    if command not in ("eval", "demo"):  # these name options of other commands too
        unknown = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", text)) - known
        assert not unknown - {"--data", "--preset"}, unknown
