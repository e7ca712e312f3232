"""Presets: what ships, how layers merge, and that every mistake is told with its line."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest

from gsdmsr_cli.backends.cuda.compiler import MOST_VIEWS
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.options import preset_files, strict
from gsdmsr_cli.options.preset import Preset, TrainingOptions, load_preset


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / f"{name}.yaml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.fixture
def presets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty preset folder in place of the shipped one."""
    folder = tmp_path / "presets"
    folder.mkdir()
    monkeypatch.setattr(preset_files, "preset_folder", lambda: folder)
    return folder


def refusal(name: str | None, config: Path | None, *overrides: str) -> str:
    with pytest.raises(UsageError) as caught:
        load_preset(name, config, overrides)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_the_presets_ship() -> None:
    names = {"default", "dnerf", "hexplane", "static", "4dgs", "gsdmsr", "gsdmsr-literal"}
    names |= {"video", "nerfies", "hypernerf", "n3v", "dynamic-object", "dual-domain"}
    names |= {"4d-covariance", "pvg", "spacetime", "spacetime-lite", "ex4dgs"}
    names |= {"sc-gs", "speedy", "static-video"}
    names |= {"grid4d", "compact"}
    assert names <= set(preset_files.preset_names())


@pytest.mark.parametrize("name", preset_files.preset_names())
def test_every_preset_loads_and_survives_being_dumped(name: str, tmp_path: Path) -> None:
    preset = load_preset(name, None, [])
    # JSON is YAML: this is how a run folder keeps the resolved preset
    config = write(tmp_path, "resolved", json.dumps(strict.dump(preset)))
    assert load_preset(None, config, []) == preset


@pytest.mark.parametrize("name", preset_files.preset_names())
def test_a_preset_says_what_differs_in_under_25_lines(name: str) -> None:
    if name != "default":  # which spells out everything
        path = preset_files.preset_folder() / f"{name}.yaml"
        assert len(path.read_text(encoding="utf-8").splitlines()) < 25


def test_the_default_preset_spells_out_every_default() -> None:
    assert load_preset(None, None, []) == Preset()
    path = preset_files.preset_folder() / "default.yaml"
    mapping = preset_files.read(path).without("description")
    expected = strict.dump(Preset())
    expected["motion"] = {"name": mapping["motion"]["name"]}
    assert strict.dump(Preset()).keys() == mapping.keys()
    for topic, options in expected.items():
        if isinstance(options, dict):
            assert options.keys() <= mapping[topic].keys(), topic


@pytest.mark.parametrize(("name", "base"), [("static", "dnerf"), ("hexplane", "gsdmsr")])
def test_these_differ_from_their_base_in_the_motion_alone(name: str, base: str) -> None:
    """And in the layers that ask how it turns splats."""
    own, other = load_preset(name, None, []), load_preset(base, None, [])
    assert own.motion["name"] == name and not own.layers
    assert dataclasses.replace(own, motion=other.motion, layers=other.layers) == other


def test_layers_override_in_order(presets: Path, tmp_path: Path) -> None:
    write(presets, "low", "splats: {count: 1, sh_degree: 0}\ntraining: {steps: 1, seed: 1}\n")
    write(presets, "high", "base: low\ntraining:\n  steps: 2\n  threads: 2\n")
    config = write(tmp_path, "config", "training: {threads: 3}")
    preset = load_preset("high", config, ["training.seed=4", "training.seed=5"])
    assert preset.splats.count == 1
    assert preset.splats.sh_degree == 0
    assert preset.training == TrainingOptions(steps=2, threads=3, seed=5)


def test_the_base_of_a_config_is_its_preset(tmp_path: Path) -> None:
    config = write(tmp_path, "config", "base: hexplane\n")
    assert load_preset(None, config, []) == load_preset("hexplane", None, [])
    assert load_preset("hexplane", config, []) == load_preset("hexplane", None, [])
    assert "config.yaml:1: base 'hexplane' contradicts --preset static" in refusal("static", config)


def test_motion_options_merge_only_under_the_same_name(presets: Path, tmp_path: Path) -> None:
    write(presets, "low", "motion: {name: a, width: 1, depth: 1}")
    write(presets, "same", "base: low\nmotion: {name: a, width: 2}")
    write(presets, "unnamed", "base: low\nmotion: {width: 2}")
    write(presets, "other", "base: low\nmotion: {name: b, width: 2}")
    merged = {"name": "a", "width": 2, "depth": 1}
    assert load_preset("same", None, []).motion == merged
    assert load_preset("unnamed", None, []).motion == merged
    assert load_preset("other", None, []).motion == {"name": "b", "width": 2}
    for order in (["motion.name=b", "motion.rank=3"], ["motion.rank=3", "motion.name=b"]):
        assert load_preset("low", None, order).motion == {"name": "b", "rank": 3}


def test_motion_options_remember_their_lines(tmp_path: Path) -> None:
    config = write(tmp_path, "config", "motion:\n  name: a\n  width: 1\n")
    motion = load_preset(None, config, ["motion.rank=2"]).motion
    assert isinstance(motion, strict.Located)
    assert motion.places["width"] == f"{config}:3"
    assert motion.places["rank"] == "--set motion.rank=2"


def test_overrides_are_yaml() -> None:
    overrides = [
        "optimizer.means=[1e-3, 1E-5]",
        "density.reset_at=[]",
        "training.budget=2.5m",
        "data={downscale: 2, background: black}",
        "splats.opacity=.25",
        "motion={name: static}",
    ]
    preset = load_preset(None, None, overrides)
    assert preset.optimizer.means == (1e-3, 1e-5)
    assert preset.density.reset_at == ()
    assert preset.training.budget == "2.5m"
    assert (preset.data.downscale, preset.data.background) == (2, "black")
    assert preset.splats.opacity == 0.25
    assert preset.motion == {"name": "static"}
    assert (
        load_preset(None, None, ["training.budget=8m", "training.budget="]).training.budget is None
    )


def test_an_unknown_key_is_told_with_its_line_and_the_nearest(tmp_path: Path) -> None:
    config = write(tmp_path, "config", "# a comment\ntraining:\n  seed: 1\n  step: 3\n")
    message = refusal(None, config)
    assert message == f"{config}:4: unknown key 'training.step'; did you mean 'steps'?"


def test_an_unknown_preset_names_the_nearest() -> None:
    assert refusal("hexplan", None) == "unknown preset 'hexplan'; did you mean 'hexplane'?"
    assert refusal("../presets/default", None).startswith("unknown preset '../presets/default'")


def test_a_circle_of_bases_is_told(presets: Path) -> None:
    write(presets, "a", "base: b")
    write(presets, "b", "base: c")
    write(presets, "c", "base: a")
    assert refusal("a", None) == "preset 'a' inherits from itself: a -> b -> c -> a"


@pytest.mark.parametrize(
    ("text", "line", "reason"),
    [
        ("training:\n  steps: [1\nseed: 2\n", 3, "is not YAML"),
        ("training:\n\tsteps: 1\n", 2, "is not YAML"),
        ("a: &x {b: 1}\ntraining: *x\n", 2, "aliases"),
        ("training: &x\n  steps: *x\n", 2, "aliases"),
        ("training: {}\ndata: {}\ntraining: {}\n", 3, "key 'training' stands twice"),
        ("data:\n  downscale: !!python/object/apply:os.getcwd []\n", 2, "the tag"),
        ("data:\n  downscale: !!python/name:os.getcwd x\n", 2, "the tag"),
        ("data:\n  downscale: !!int x\n", 2, "cannot be read"),
        ("1: 2\n", 1, "key 1 is not a name"),
        ("? [a]\n: 2\n", 1, "is not a name"),
        ("base: [a]\n", 1, "base is not the name"),
        ("- a\n", None, "holds no mapping"),
        ("--- {}\n--- {}\n", 2, "is not YAML"),
        ("data: \x07\n", None, "is not YAML"),
        ("[" * 3000, None, "is nested too deeply"),
    ],
)
def test_a_file_that_is_no_preset_is_refused(
    text: str, line: int | None, reason: str, tmp_path: Path
) -> None:
    config = write(tmp_path, "config", text)
    message = refusal(None, config)
    assert message.startswith(f"{config}:{line}: " if line else f"{config}")
    assert reason in message


def test_files_that_cannot_be_read_are_refused(tmp_path: Path) -> None:
    assert refusal(None, tmp_path / "none.yaml").endswith("No such file or directory")
    assert "cannot be read" in refusal(None, tmp_path)
    (tmp_path / "latin.yaml").write_bytes(b"data: \xe9\n")
    assert "is not UTF-8" in refusal(None, tmp_path / "latin.yaml")


def test_an_empty_config_changes_nothing(tmp_path: Path) -> None:
    assert load_preset(None, write(tmp_path, "config", "# nothing\n"), []) == Preset()


@pytest.mark.parametrize("override", ["training.steps", "=3", "a..b=1", ".a=1", "a.=1", ""])
def test_a_malformed_override_is_refused(override: str) -> None:
    assert refusal(None, None, override).startswith(f"--set {override}: allowed: a.b=value")


@pytest.mark.parametrize(
    "value",
    [
        "!!bool x", "!!int", "!!int ''", "!!float x", "!!timestamp x", "!!binary é", "!!set {a}",
        "!!omap [a]", "!!null x", "!own x", "9" * 5000, "[" * 900 + "]" * 900,
        "!!python/object/apply:os.getcwd []",
    ],
)  # fmt: skip
def test_values_that_are_no_options_are_refused(value: str) -> None:
    assert refusal(None, None, f"training.steps={value}").startswith("--set training.steps=")


@pytest.mark.parametrize(
    "override",
    [
        "data.downscale=0",
        "data.background=grey",
        "data.cache_mib=-1",
        "splats.count=0",
        "splats.opacity=1",
        "splats.moving_share=1.5",
        "splats.sh_degree=4",
        "splats.sh_start=1.1",
        "training.steps=0",
        "training.steps=010",
        "training.steps=true",
        "training.budget=8",
        "training.budget=1:30",
        "training.budget=0m",
        "training.static_until=-0.1",
        "training.static_steps=-1",
        "training.low_resolution_until=2",
        "training.views_per_step=0",
        "training.checkpoint_minutes=0",
        "training.seed=-1",
        "training.threads=-1",
        "training.precision=half",
        "losses.ssim=1.5",
        "losses.ssim_until=-0.1",
        "training.average_from=1.5",
        "optimizer.means=[1e-3, 0]",
        "optimizer.network=[1e-3]",
        "density.every=0",
        "density.until=.nan",
        "density.gradient=0",
        "density.prune_opacity=1",
        "density.reset_at=[0.1, 2]",
        "density.thin_at=[0.5, 2]",
        "density.thin_share=1",
        "density.cap=0",
        "motion={depth: 2}",
        "motion.name=3",
        "motion=hexplane",
        "training=null",
    ],
)
def test_values_out_of_range_are_refused_where_they_stand(override: str, presets: Path) -> None:
    write(presets, "default", "")
    message = refusal(None, None, override)
    assert "; allowed: " in message
    assert message.startswith(f"--set {override}: ")


@pytest.mark.parametrize("in_file", [True, False])
def test_the_earlier_name_of_a_motion_is_read_with_a_hint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], in_file: bool
) -> None:
    text = "base: default\nmotion:\n  name: nodes\n  count: 64\n"
    config = write(tmp_path, "config", text) if in_file else None
    overrides = [] if in_file else ["motion.name=nodes", "motion.count=64"]
    preset_files._hint.cache_clear()
    loaded = [load_preset(None, config, overrides).motion for _ in range(2)]
    assert loaded == [{"name": "control_points", "count": 64}] * 2
    place = f"{config}:3" if in_file else "--set motion.name=nodes"
    hint = f"hint: {place}: the motion 'nodes' is called 'control_points' now\n"
    assert capsys.readouterr().err == hint  # once


def test_options_under_the_earlier_name_add_to_those_under_the_present_one(presets: Path) -> None:
    write(presets, "low", "motion: {name: control_points, count: 64}")
    motion = load_preset("low", None, ["motion={name: nodes, neighbours: 4}"]).motion
    assert motion == {"name": "control_points", "count": 64, "neighbours": 4}


def test_a_step_has_the_views_that_suit_the_device_unless_options_say() -> None:
    training = load_preset("dnerf", None, []).training
    assert training.views_per_step is None
    assert training.views_on("cpu") < training.views_on("cuda") <= MOST_VIEWS
    assert training.views_on("cuda", at_once=False) == training.views_on("cpu")
    chosen = load_preset("dnerf", None, ["training.views_per_step=3"]).training
    assert chosen.views_on("cpu") == chosen.views_on("cuda") == 3
