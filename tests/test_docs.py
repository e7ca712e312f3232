"""The worked examples in docs/ run as they stand, and links and commands in the pages exist."""

from __future__ import annotations

import importlib
import re
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import torch
from datasets import noise, write_json, write_picture
from kernel_checks import generator
from motion_checks import started
from seam_checks import assert_trains_the_same_in_all_ways
from training_checks import STEPS, preset_of, trainer_of

from gsdmsr_cli import exports, formats, ops, paths, raster
from gsdmsr_cli.demo.synthetic import write_scene
from gsdmsr_cli.formats import dnerf, read_scene
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground import plugins
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.model import layers
from gsdmsr_cli.model import motion as motions
from gsdmsr_cli.model.building import load_model, start_model
from gsdmsr_cli.model.layer import Facts, Instant
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.ops.planes import CUBE
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.options.strict import Located
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.film import PathOptions
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.training import losses, population
from gsdmsr_cli.training.trainer import Trainer

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
COMMANDS = (
    "make", "prepare", "train", "view", "eval", "compare", "render", "export", "info", "demo",
    "presets", "doctor", "weights", "cache", "benchmark",
)  # fmt: skip


def examples(page: str) -> list[str]:
    """Return the blocks of Python in a page."""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    found = re.findall(r"^```python\n(.*?)^```$", text, re.MULTILINE | re.DOTALL)
    assert found, page
    return found


def installed(package: ModuleType, name: str, page: str, folder: Path) -> Iterator[ModuleType]:
    """Put the page's example into a package, as if its file lay there, and yield the module."""
    (folder / f"{name}.py").write_text(examples(page)[0], encoding="utf-8")
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


@pytest.fixture
def xyz(tmp_path: Path) -> Iterator[ModuleType]:
    yield from installed(exports, "xyz", "adding-an-export.md", tmp_path)


@pytest.fixture
def brightness(tmp_path: Path) -> Iterator[ModuleType]:
    yield from installed(layers, "brightness", "adding-a-layer.md", tmp_path)


@pytest.fixture
def sparsity(tmp_path: Path) -> Iterator[ModuleType]:
    yield from installed(losses, "sparsity", "adding-a-loss.md", tmp_path)


@pytest.fixture
def duplicate(tmp_path: Path) -> Iterator[ModuleType]:
    yield from installed(population, "duplicate", "adding-an-event.md", tmp_path)


@pytest.fixture
def plain(tmp_path: Path) -> Iterator[ModuleType]:
    yield from installed(raster, "plain", "adding-an-engine.md", tmp_path)


@pytest.fixture
def temporal_opacity(tmp_path: Path) -> Iterator[ModuleType]:
    """The example of an operation: a folder of three files."""
    folder, name = tmp_path / "temporal_opacity", "gsdmsr_cli.ops.temporal_opacity"
    folder.mkdir()
    files = ("__init__.py", "twin.py", "cpu.py")
    for file, text in zip(files, examples("adding-an-op.md"), strict=True):
        (folder / file).write_text(text, encoding="utf-8")
    ops.__path__.append(str(tmp_path))
    importlib.invalidate_caches()
    try:
        yield importlib.import_module(name)
    finally:
        ops.__path__.remove(str(tmp_path))
        for module in [m for m in sys.modules if m == name or m.startswith(f"{name}.")]:
            del sys.modules[module]


def test_the_example_of_a_layer_brightens_and_trains(
    brightness: ModuleType, tiny_scene: Path, tmp_path: Path
) -> None:
    options = "layers=[{name: brightness, keyframes: 3}]"
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, options)
    layer = trainer.model.layers["layers.brightness"]
    assert trainer.model.tensors()["layers.brightness.offsets"].any()
    with torch.no_grad():
        layer.tensors()["offsets"].copy_(torch.tensor([1.0, 2.0, 4.0]))
    splats = splats_of(4)
    for time, offset in [(0.0, 1.0), (0.25, 1.5), (0.75, 3.0), (1.0, 4.0)]:
        found = layer.at(Moment(splats), Instant(time)).splats
        torch.testing.assert_close(found.sh, splats.sh + offset)
        assert torch.equal(found.means, splats.means)
    with pytest.raises(UsageError, match="keyframes is 1; allowed: 2 or more"):
        trainer_of(tiny_scene, preset_of("layers=[{name: brightness, keyframes: 1}]"))


def test_the_example_of_a_term_makes_splats_transparent(
    sparsity: ModuleType, tiny_scene: Path, tmp_path: Path
) -> None:
    terms = "losses.terms=[{{name: sparsity, factor: {}, until: 0.5}}]"
    assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, terms.format(0.01))
    (term,) = trainer_of(tiny_scene, preset_of(terms.format(0.3))).renderer.terms
    assert [term.weight(progress) for progress in (0.0, 0.49, 0.5)] == [0.3, 0.3, 0.0]
    means = []
    for factor in (0.0, 10.0):
        trainer = trainer_of(tiny_scene, preset_of(terms.format(factor), "density.reset_at=[]"))
        for _ in range(STEPS // 2):
            trainer.step()
        means.append(float(trainer.model.splats.logit_opacities.detach().sigmoid().mean()))
    assert means[1] < 0.8 * means[0]


def test_the_example_of_an_event_copies_splats(
    duplicate: ModuleType, tiny_scene: Path, tmp_path: Path
) -> None:
    own = "{name: duplicate, count: 7, every: 10, most: 3}"
    options = f"events=[density, opacity_reset, {own}]", "density.gradient=1.0"
    unpruned = "density.prune_opacity=0.0", "density.prune_scale=1000000.0"
    trainer = assert_trains_the_same_in_all_ways(tiny_scene, tmp_path, *options, *unpruned)
    assert len(trainer.model.splats) == 120 + 3 * 7
    assert trainer.checkpoint().state["events"]["duplicate"] == {"times": 3}


def test_the_example_of_an_operation_is_its_twin(temporal_opacity: ModuleType) -> None:
    for count in (0, 1, 37):
        rng = generator(count)
        given = [torch.randn(count, generator=rng) for _ in range(3)]
        weights = torch.randn(count, generator=rng)
        outcomes = []
        for dtype in (torch.float32, torch.float64):
            leaves = [tensor.to(dtype).requires_grad_() for tensor in given]
            faded = temporal_opacity.temporal_opacity(*leaves, 0.3)
            gradients = torch.autograd.grad((faded * weights.to(dtype)).sum(), leaves)
            outcomes.append([faded.detach(), *gradients])
            assert type(faded.grad_fn).__name__.startswith("_Temp") == (dtype == torch.float32)
        for found, exact in zip(*outcomes, strict=True):
            torch.testing.assert_close(found, exact.float(), rtol=1e-5, atol=1e-5)
    leaves = [tensor.double().requires_grad_() for tensor in given]
    assert torch.autograd.gradcheck(lambda *t: temporal_opacity.temporal_opacity(*t, 0.3), leaves)


def test_the_example_of_an_engine_conforms(
    plain: ModuleType, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(ROOT / "tests" / "raster")
    conformance, scenes = map(importlib.import_module, ("test_conformance", "raster_scenes"))
    monkeypatch.setattr(raster, "FASTEST_FIRST", (*raster.FASTEST_FIRST, "plain"))
    assert raster.engine_names()[-1] == "plain"
    engine = raster.load_engine("plain")
    assert engine.unavailable("cpu") is None and engine.unavailable("cuda") is not None
    placed = engine, "cpu"
    for name in ("saturated", "behind and at the near plane", *sorted(scenes.WITH_FEATURES)[:2]):
        conformance.test_pictures_match_the_reference(placed, name)
        conformance.test_gradients_match_the_reference(placed, name)
        conformance.test_radii_and_screen_means_match_the_reference(placed, name)
    for rows in (scenes.poisoned, scenes.poisoned_moment):
        conformance.test_rows_that_are_not_finite_are_as_if_absent(placed, rows)


def test_the_example_of_an_export_writes_and_refuses(xyz: ModuleType, tmp_path: Path) -> None:
    model = Model(splats_of(5), {"motion": started("static", 5)})
    facts, out = Facts(1.3, CUBE, 10), tmp_path / "made" / "a.xyz"
    assert "xyz" in exports.format_names()
    harmonics = model.splats.sh.detach().repeat(1, 4, 1)
    shaded = Model(replace(model.splats, sh=harmonics), {"motion": started("static", 5)})
    refused = "cannot carry sizes and opacities nor colours that depend on the view of this run"
    with pytest.raises(UsageError, match=f"--format xyz {refused}"):
        exports.export("xyz", shaded, facts, Located({"time": 0.5}), out)
    assert not out.parent.exists()
    settings = {"time": 0.5, "digits": 3, "lossy": True, "axes": "y-up", "scale": 2.0}
    written = exports.export("xyz", model, facts, Located(settings), out)
    assert (written.files, written.splats) == ([out], 5)
    rows, splats = np.loadtxt(out), model.splats.detach()
    x, y, z = 2 * splats.means.numpy().T
    np.testing.assert_allclose(rows[:, :3], np.stack([x, z, -y], axis=1), atol=0.5e-3 + 1e-6)
    colours = np.clip(0.5 + 0.28209479177387814 * splats.sh[:, 0].numpy(), 0, 1)
    assert set(np.abs(rows[:, 3:] - 255 * colours).round().flat) <= {0, 1}
    with pytest.raises(UsageError, match="digits is 10; allowed: 0 to 9"):
        exports.export("xyz", model, facts, Located({"digits": 10}), out)
    with pytest.raises(
        UsageError, match="frames is not for --format xyz, which takes time, digits"
    ):
        exports.export("xyz", model, facts, Located({"frames": 2}), out)


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


FACTS = Facts(1.3, CUBE, 10)


def model_of(settings: dict[str, Any], count: int) -> Model:
    return start_model(splats_of(count), settings, (), FACTS, generator())


def test_the_example_of_a_motion_keeps_to_the_rules(linear: ModuleType) -> None:
    model = model_of({"name": "linear"}, 5)
    splats, motion = splats_of(5), model.layers["motion"]

    def moved_to(time: float, splats: Splats) -> Splats:
        return motion.at(Moment(splats), Instant(time)).splats

    assert motion.identity_at_start
    assert torch.equal(moved_to(0.9, splats).means, splats.means)
    velocities = model.tensors()["motion.velocities"]
    with torch.no_grad():
        velocities += torch.arange(15.0).reshape(5, 3)
    moved = moved_to(1.0, splats)
    torch.testing.assert_close(moved.means, splats.means + 0.5 * velocities)
    penalty = motion.penalty(Moment(splats), Instant(0.5), torch.Generator())
    assert penalty is not None and penalty > 0
    rows = torch.tensor([4, 0, 0])
    motion.take(rows, torch.tensor([False, False, True]))
    assert torch.equal(moved_to(1.0, splats.take(rows)).means, moved.means[rows])
    with pytest.raises(UsageError, match="slownes"):
        model_of({"name": "linear", "slownes": 1.0}, 5)


def test_the_example_of_a_motion_is_saved_and_loaded(linear: ModuleType) -> None:
    model = model_of({"name": "linear"}, 5)
    with torch.no_grad():
        model.tensors()["motion.velocities"].normal_(generator=generator())
    model.take(torch.tensor([1, 1, 3]), torch.tensor([False, True, False]))
    tensors = {name: tensor.detach().clone() for name, tensor in model.tensors().items()}
    loaded = load_model(tensors, {"name": "linear"}, (), FACTS, 1.0)
    found, expected = (one.at(one.instant(0.2)).splats for one in (loaded, model))
    assert torch.equal(found.means, expected.means)
    assert not torch.equal(found.means, model.splats.means)


def test_the_example_of_a_motion_trains_and_grows(linear: ModuleType, tmp_path: Path) -> None:
    data = tmp_path / "scene"
    write_scene(data, size=32, train=6, val=1, test=1)
    options = [
        "motion={name: linear}", "splats.count=150", "training.steps=40", "density.start=10",
        "density.every=10", "density.until=1.0", "density.gradient=1e-9", "density.cap=400",
        "density.reset_at=[]", "training.static_until=0.1", "losses.quadratic=0",
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
    made = {
        f"gsdmsr_cli/{name}.py"
        for name in (
            "model/motion/linear", "model/layers/brightness", "formats/turntable", "paths/swing",
            "exports/xyz", "training/losses/sparsity", "training/population/duplicate",
            "raster/plain", "ops/temporal_opacity/__init__", "ops/temporal_opacity/twin",
            "ops/temporal_opacity/cpu",
        )
    }  # fmt: skip
    text = page.read_text(encoding="utf-8")
    for path in set(re.findall(r"\b(?:gsdmsr_cli|tests|presets)/[\w/]+\.(?:py|yaml)", text)):
        assert (ROOT / path).is_file() or path in made | {"presets/linear.yaml"}, path


@pytest.mark.parametrize("command", COMMANDS)
def test_every_subcommand_has_a_page_that_names_its_options(command: str) -> None:
    from typer.main import get_command

    from gsdmsr_cli.cli.main import app

    group: Any = get_command(app)
    assert set(group.commands) == set(COMMANDS)
    text = (ROOT / "docs" / f"{command}.md").read_text(encoding="utf-8")
    entry = group.commands[command]
    entries = list(entry.commands.values()) if hasattr(entry, "commands") else [entry]
    options = [name for e in entries for p in e.params for name in p.opts if name[:2] == "--"]
    everywhere = {"--json", "--quiet", "--verbose", "--log-file"}
    common = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    for option in options:
        assert option in (common if option in everywhere else text), option
    known = {"--help", *options}
    if command == "benchmark":  # benchmark soak measures another command, with that one's options
        known |= {
            name for c in ("train", "render") for p in group.commands[c].params for name in p.opts
        }
    if command not in ("make", "eval", "demo", "presets", "view", "export"):
        # these name options of other commands too
        unknown = set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", text)) - known
        assert not unknown - {"--data", "--preset"}, unknown
