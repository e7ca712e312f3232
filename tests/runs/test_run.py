"""The run folder: what is written comes back, nothing is left half written, others are refused."""

from __future__ import annotations

import json
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_checks import splats_of
from safetensors import safe_open
from safetensors.torch import save_file

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.model.building import start_model
from gsdmsr_cli.model.layer import Facts
from gsdmsr_cli.options.preset import Preset, load_preset
from gsdmsr_cli.runs import checkpoints, earlier
from gsdmsr_cli.runs.beginning import continue_run, create_run, refuse_used
from gsdmsr_cli.runs.checkpoints import Checkpoint
from gsdmsr_cli.runs.run import Run, open_run
from gsdmsr_cli.runs.seen_pictures import PICTURES, remember
from gsdmsr_cli.scene.scene import Scene

FACTS = Facts(bound=1.3, box=((-1.0, -1.1, -1.2), (1.3, 1.2, 1.1)), frames=12)
NOTHING = np.zeros((0, 3), np.float32)


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    data = tmp_path / "data"
    data.mkdir()
    return Scene(data, "dnerf", (), NOTHING, NOTHING, None, 1.3, "f1n9er")


@pytest.fixture
def run(tmp_path: Path, scene: Scene) -> Run:
    return create_run(tmp_path / "run", "dnerf", load_preset("static", None, []), FACTS, scene)


def checkpoint_of(step: int = 7) -> Checkpoint:
    rng = torch.Generator().manual_seed(step)
    tensors = {
        "splats.means": torch.randn(5, 3, generator=rng),
        "strided": torch.randn(4, 6, generator=rng).t(),
        "empty": torch.zeros(0, 3),
        "generator": rng.get_state(),
    }
    state = {"queue": [3, 1], "moving": True, "adam_steps": {"splats.means": step}}
    return Checkpoint(step, 0.25, 12.5, tensors, state)


def files_of(run: Run) -> set[str]:
    """The files of a run but the one that says what its pictures were."""
    return {path.name for path in run.root.iterdir()} - {PICTURES}


def test_a_created_run_is_opened_as_it_was(tmp_path: Path, scene: Scene) -> None:
    options = ["training.steps=31", "density.reset_at=[0.1, 0.2]", "motion.levels=[32, 64]"]
    preset = load_preset("hexplane", None, options)
    created = create_run(tmp_path / "a" / "b" / "run", "hexplane", preset, FACTS, scene)
    opened = open_run(tmp_path / "a" / "b" / "run")
    assert opened == created
    assert opened.preset == preset and opened.facts == FACTS
    assert (opened.data, opened.layout) == (scene.root.resolve(), "dnerf")
    assert opened.data.is_absolute()


def test_a_run_given_with_a_relative_path_remembers_where_the_data_lies(
    tmp_path: Path, scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    near = replace(scene, root=Path("data"))
    create_run(Path("run"), "dnerf", Preset(), FACTS, near)
    monkeypatch.chdir("/")
    assert open_run(tmp_path / "run").data == tmp_path.resolve() / "data"


def test_a_folder_that_was_moved_is_as_good(run: Run, tmp_path: Path) -> None:
    run.save(checkpoint_of())
    run.log({"step": 1})
    moved = Path(shutil.move(run.root, tmp_path / "elsewhere"))
    opened = open_run(moved)
    assert opened == replace(run, root=moved)
    assert opened.load().step == 7 and opened.log_path.is_file()


def test_a_checkpoint_comes_back_the_same(run: Run) -> None:
    saved = checkpoint_of()
    run.save(saved)
    found = open_run(run.root).load()
    assert (found.step, found.progress, found.elapsed) == (7, 0.25, 12.5)
    assert found.state == saved.state
    assert found.tensors.keys() == saved.tensors.keys()
    for name, tensor in saved.tensors.items():
        assert found.tensors[name].dtype == tensor.dtype, name
        assert torch.equal(found.tensors[name], tensor), name


def test_the_last_checkpoint_takes_the_place_of_the_one_before(run: Run) -> None:
    run.save(checkpoint_of(7))
    run.save(checkpoint_of(8))
    assert run.load().step == 8
    assert files_of(run) == {"run.json", "checkpoint.safetensors"}


def fails_halfway(tensors: Any, path: Path, metadata: Any) -> None:
    Path(path).write_bytes(b"half of a checkpo")
    raise OSError(28, "No space left on device")


def test_a_checkpoint_that_cannot_be_written_leaves_the_one_before(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    run.save(checkpoint_of(7))
    monkeypatch.setattr(checkpoints, "save_file", fails_halfway)
    with pytest.raises(DataError, match=r"checkpoint\.safetensors: cannot be written: .*No space"):
        run.save(checkpoint_of(8))
    assert run.load().step == 7
    assert files_of(run) == {"run.json", "checkpoint.safetensors"}


def test_a_kill_while_a_checkpoint_is_written_leaves_the_one_before(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A half of a file may lie beside it then; it is written over the next time."""
    run.save(checkpoint_of(7))

    def is_killed(tensors: Any, path: Path, metadata: Any) -> None:
        Path(path).write_bytes(b"half of a checkpo")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(checkpoints, "save_file", is_killed)
        run.save(checkpoint_of(8))
    assert open_run(run.root).load().step == 7
    run.save(checkpoint_of(9))
    assert open_run(run.root).load().step == 9
    assert files_of(run) == {"run.json", "checkpoint.safetensors"}


def keeping(run: Run, count: int) -> Run:
    return replace(run, preset=load_preset("static", None, [f"training.keep={count}"]))


def test_as_many_checkpoints_are_kept_as_is_wanted(run: Run) -> None:
    run, others = keeping(run, 3), run.root / "checkpoints" / "best.safetensors"
    for step in range(1, 6):
        run.save(checkpoint_of(step))
    earlier = run.root / "checkpoints"
    names = "step-000003.safetensors", "step-000004.safetensors"
    assert sorted(path.name for path in earlier.iterdir()) == list(names)
    assert run.load().step == 5
    for step, name in zip((3, 4), names, strict=True):
        checkpoint, _ = checkpoints.read(earlier / name)
        assert checkpoint.step == step
        assert torch.equal(
            checkpoint.tensors["generator"], checkpoint_of(step).tensors["generator"]
        )
    others.touch()
    keeping(run, 2).save(checkpoint_of(6))
    assert {path.name for path in earlier.iterdir()} == {"step-000005.safetensors", others.name}
    others.unlink()
    keeping(run, 1).save(checkpoint_of(7))
    assert files_of(run) == {"run.json", "checkpoint.safetensors"}


def test_a_drive_without_hard_links_keeps_copies(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(checkpoints.os, "link", refuse)
    for step in (7, 8):
        keeping(run, 2).save(checkpoint_of(step))
    checkpoint, _ = checkpoints.read(run.root / "checkpoints" / "step-000007.safetensors")
    assert checkpoint.step == 7


@pytest.mark.parametrize("damage", [lambda p: p.unlink(), lambda p: p.write_bytes(b"half")])
def test_a_damaged_checkpoint_falls_back_to_the_one_before(run: Run, damage: Any) -> None:
    run = keeping(run, 2)
    for step in (7, 8):
        run.save(checkpoint_of(step))
    assert run.load_whole()[1] is None
    damage(run.checkpoint_path)
    with pytest.raises(DataError, match=r"train --resume goes on from step-000007\.safetensors"):
        run.load()
    checkpoint, told = run.load_whole()
    assert checkpoint.step == 7
    assert told is not None and "damaged checkpoint" in told and "going on from step 7" in told
    run.save(checkpoint_of(9))  # what is damaged is not kept in place of what is whole
    assert run.load().step == 9
    assert [path.name for path in checkpoints.kept(run.root)] == ["step-000007.safetensors"]


def test_the_checkpoint_before_stays_until_the_new_one_can_be_read(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a drive that takes all bytes and keeps half of them."""
    run.save(checkpoint_of(7))

    def lies(tensors: Any, path: Path, metadata: Any) -> None:
        save_file(tensors, path, metadata)
        Path(path).write_bytes(Path(path).read_bytes()[:-9])

    monkeypatch.setattr(checkpoints, "save_file", lies)
    with pytest.raises(DataError, match=r"checkpoint\.safetensors: cannot be written"):
        run.save(checkpoint_of(8))
    assert run.load().step == 7
    assert files_of(run) == {"run.json", "checkpoint.safetensors"}


@pytest.mark.skipif(os.name == "nt", reason="Windows has no umask")
@pytest.mark.parametrize("umask", [0o022, 0o027, 0o077])
def test_files_have_the_rights_that_the_umask_gives(run: Run, scene: Scene, umask: int) -> None:
    before = os.umask(umask)
    try:
        run.describe()
        remember(run.root, scene, whole=True)
        run.log({"step": 1})
        for step in (7, 8):
            keeping(run, 2).save(checkpoint_of(step))
    finally:
        os.umask(before)
    for path in run.root.rglob("*.*"):
        assert path.stat().st_mode & 0o777 == 0o666 & ~umask, path


def test_a_log_goes_on_after_a_line_that_was_cut_short(run: Run) -> None:
    run.log({"step": 3})
    with run.log_path.open("a") as file:
        file.write('{"step": 4, "lo')
    run.log({"step": 4}, {"step": 5})
    assert run.read_log() == [{"step": 3}, {"step": 4}, {"step": 5}]


def test_the_model_of_a_checkpoint_is_for_drawing(run: Run) -> None:
    rng = torch.Generator().manual_seed(0)
    model = start_model(splats_of(6), {"name": "static"}, (), FACTS, rng)
    run.save(replace(checkpoint_of(), tensors={**model.tensors(), "adam.first.x": torch.ones(2)}))
    loaded, checkpoint = run.load_model()
    assert checkpoint.step == 7
    for name, tensor in loaded.tensors().items():
        assert torch.equal(tensor, model.tensors()[name]) and not tensor.requires_grad, name


@pytest.mark.parametrize("length", [0, 5, 200, -1])
def test_a_cut_checkpoint_is_told(run: Run, length: int) -> None:
    run.save(checkpoint_of())
    whole = run.checkpoint_path.read_bytes()
    run.checkpoint_path.write_bytes(whole[:length])
    with pytest.raises(DataError, match=r"checkpoint\.safetensors: damaged checkpoint") as caught:
        run.load()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "header", [None, {}, {"gsdmsr": "{"}, {"gsdmsr": "[]"}, {"gsdmsr": '{"step": 1}'}]
)
def test_a_checkpoint_of_someone_else_is_told(run: Run, header: dict[str, str] | None) -> None:
    checkpoints.save_file({"weight": torch.ones(2)}, run.checkpoint_path, metadata=header)
    with pytest.raises(DataError, match="damaged checkpoint"):
        run.load()


@pytest.mark.parametrize(
    "change",
    [
        {"elapsed": 10**400}, {"step": float("inf")}, {"state": 3}, {"schema": None},
        {"schema": 1, "state": {"adam_steps": "x", "events": {}}},
        {"schema": 1, "state": {"adam_steps": {}, "adam_restarts": 1, "events": {}}},
    ],
)  # fmt: skip
def test_a_checkpoint_with_values_of_other_kinds_is_told(run: Run, change: dict[str, Any]) -> None:
    state = {"schema": 2, "step": 1, "progress": 0.1, "elapsed": 1, "state": {}} | change
    header = {"gsdmsr": json.dumps(state)}
    checkpoints.save_file({"weight": torch.ones(2)}, run.checkpoint_path, metadata=header)
    with pytest.raises(DataError, match="damaged checkpoint"):
        run.load()


def test_a_log_that_is_nested_too_deeply_is_told(run: Run) -> None:
    run.log_path.write_text("[" * 100_000 + "\n")
    with pytest.raises(DataError, match=r"metrics\.jsonl: cannot be read"):
        run.read_log()


def test_a_run_without_a_checkpoint_is_told(run: Run) -> None:
    with pytest.raises(DataError, match="no checkpoint yet; train it again with --overwrite"):
        run.load()


@pytest.mark.parametrize("make", [lambda p: None, lambda p: p.mkdir(), lambda p: p.touch()])
def test_a_folder_that_is_no_run_is_told(tmp_path: Path, make: Any) -> None:
    make(tmp_path / "x")
    with pytest.raises(DataError, match=r"x: not a run folder \(no run\.json\)"):
        open_run(tmp_path / "x")


def without(document: dict[str, Any], *path: str) -> dict[str, Any]:
    inner = document
    for key in path[:-1]:
        inner = inner[key]
    del inner[path[-1]]
    return document


def with_value(document: dict[str, Any], value: Any, *path: str) -> dict[str, Any]:
    inner = document
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return document


DAMAGES = {
    "no preset": lambda d: without(d, "preset"),
    "no data": lambda d: without(d, "data"),
    "no fingerprint": lambda d: without(d, "data", "fingerprint"),
    "no bound": lambda d: without(d, "facts", "bound"),
    "preset is a list": lambda d: with_value(d, [], "preset"),
    "data is text": lambda d: with_value(d, "here", "data"),
    "data is null": lambda d: with_value(d, None, "data"),
    "unknown option": lambda d: with_value(d, 3, "preset", "training", "stesp"),
    "wrong type": lambda d: with_value(d, "many", "preset", "training", "steps"),
}


@pytest.mark.parametrize("damage", DAMAGES.values(), ids=DAMAGES)
def test_a_damaged_description_is_told(run: Run, damage: Any) -> None:
    path = run.root / "run.json"
    path.write_text(json.dumps(damage(json.loads(path.read_text()))))
    with pytest.raises(DataError, match=r"run\.json.*damaged") as caught:
        open_run(run.root)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[]", "null", "\xff", '{"schema": 1'])
def test_a_description_that_is_no_json_object_is_told(run: Run, text: str) -> None:
    (run.root / "run.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(DataError, match=r"run\.json"):
        open_run(run.root)


def test_a_description_of_another_schema_is_told(run: Run) -> None:
    path = run.root / "run.json"
    path.write_text(json.dumps(with_value(json.loads(path.read_text()), 99, "schema")))
    with pytest.raises(DataError, match="has schema 99; this version reads 1 and 2"):
        open_run(run.root)


def test_an_unused_place_is_fine(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    refuse_used(tmp_path / "empty", overwrite=False)
    refuse_used(tmp_path / "not" / "there", overwrite=False)


def test_a_run_is_replaced_only_if_asked_for(run: Run, scene: Scene) -> None:
    run.save(checkpoint_of())
    with pytest.raises(DataError, match="holds a run; continue it with --resume or"):
        create_run(run.root, "dnerf", Preset(), FACTS, scene)
    assert run.load().step == 7
    create_run(run.root, "dnerf", Preset(), FACTS, scene, overwrite=True)
    assert files_of(run) == {"run.json"}


def test_replacing_a_run_removes_nothing_that_train_has_not_written(run: Run, scene: Scene) -> None:
    run.save(checkpoint_of())
    run.log({"step": 1})
    run.training_path.touch()
    others = {"notes.md", ".tmpAbc123", ".mine.part.txt", "checkpoints/best.safetensors", "eval/a"}
    for name in others:
        (run.root / name).parent.mkdir(exist_ok=True)
        (run.root / name).write_text("of somebody")
    create_run(run.root, "dnerf", Preset(), FACTS, scene, overwrite=True)
    files = {str(path.relative_to(run.root)) for path in run.root.rglob("*") if path.is_file()}
    assert files == {"run.json", PICTURES, *others}


def test_a_description_of_another_program_is_no_run(tmp_path: Path, scene: Scene) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "run.json").write_text('{"gsdmsr": "is fine"}')
    with pytest.raises(DataError, match="is not a run folder"):
        create_run(tmp_path / "run", "dnerf", Preset(), FACTS, scene, overwrite=True)


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_of_something_else_is_never_replaced(
    tmp_path: Path, scene: Scene, overwrite: bool
) -> None:
    thesis = tmp_path / "years" / "of work.tex"
    thesis.parent.mkdir()
    thesis.touch()
    for root in (thesis, thesis.parent):
        with pytest.raises(DataError, match="exists and is not a run folder"):
            create_run(root, "dnerf", Preset(), FACTS, scene, overwrite)
    assert thesis.is_file()


def test_a_run_folder_that_holds_the_data_is_never_replaced(run: Run, scene: Scene) -> None:
    data = run.root / "data"
    data.mkdir()
    (data / "a.png").touch()
    with pytest.raises(DataError, match="holds the data"):
        create_run(run.root, "x", Preset(), FACTS, replace(scene, root=data), overwrite=True)
    assert (data / "a.png").is_file()


def test_a_link_to_a_run_is_replaced_with_it(run: Run, scene: Scene, tmp_path: Path) -> None:
    run.save(checkpoint_of())
    (tmp_path / "link").symlink_to(run.root, target_is_directory=True)
    create_run(tmp_path / "link", "dnerf", Preset(), FACTS, scene, overwrite=True)
    assert files_of(run) == {"run.json"}
    assert open_run(tmp_path / "link").name == "dnerf"


def test_a_run_is_continued_with_other_options_and_at_another_place(
    run: Run, scene: Scene, tmp_path: Path
) -> None:
    run.save(checkpoint_of())
    longer = load_preset("static", None, ["training.steps=99999"])
    there = tmp_path / "there"
    continued = continue_run(run, longer, replace(scene, root=there))
    assert open_run(run.root) == continued
    assert (continued.preset, continued.data) == (longer, there.resolve())
    assert continued.load().step == 7


def test_a_run_is_not_continued_on_other_data(run: Run, scene: Scene) -> None:
    before = (run.root / "run.json").read_bytes()
    with pytest.raises(DataError, match=r"is not the data that .* was trained on"):
        continue_run(run, run.preset, replace(scene, fingerprint="0ther"))
    assert (run.root / "run.json").read_bytes() == before


def steps_in(run: Run) -> list[int]:
    return [json.loads(line)["step"] for line in run.log_path.read_text().splitlines()]


@given(steps=st.lists(st.integers(0, 30), max_size=12), last=st.integers(0, 30))
@settings(max_examples=30, deadline=None)
def test_the_log_is_rewound_to_a_step(
    tmp_path_factory: pytest.TempPathFactory, steps: list[int], last: int
) -> None:
    root = tmp_path_factory.mktemp("run")
    run = Run(root, "x", Preset(), FACTS, root, "dnerf", "")
    for step in steps:
        run.log({"step": step, "loss": 0.5})
    run.rewind_log(last)
    run.log({"step": 31})
    assert steps_in(run) == [*(step for step in steps if step <= last), 31]


@pytest.mark.parametrize("rest", ['{"step": 4, "lo', "{}\n", "4\n", "null\n", '{"step": "4"}\n'])
def test_a_line_whose_writing_was_interrupted_is_dropped(run: Run, rest: str) -> None:
    run.log({"step": 3})
    with run.log_path.open("a") as file:
        file.write(rest)
    run.rewind_log(10)
    run.log({"step": 5})
    assert steps_in(run) == [3, 5]


def test_a_run_without_a_log_has_nothing_to_rewind(run: Run) -> None:
    run.rewind_log(3)
    assert not run.log_path.exists()


def test_the_log_takes_numbers_only_that_json_has(run: Run) -> None:
    with pytest.raises(ValueError, match="JSON"):
        run.log({"step": 1, "loss": float("nan")})
    assert not run.log_path.exists() or not run.log_path.read_text()


def as_before_version_0_2(run: Run) -> None:
    """Rewrite a run's description and checkpoint as schema 1 had them."""
    about = json.loads((run.root / "run.json").read_text())
    about["schema"], about["preset"]["motion"]["name"] = 1, "nodes"
    assert about["preset"]["density"].pop("reset_opacity") == 0.01
    (run.root / "run.json").write_text(json.dumps(about))
    with safe_open(run.checkpoint_path, "pt") as file:
        header = json.loads(file.metadata()["gsdmsr"])
        tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118
    header["schema"] = 1
    metadata = {"gsdmsr": json.dumps(header).replace("motion.control_points", "motion.nodes")}
    old = {name.replace("motion.control_points", "motion.nodes"): t for name, t in tensors.items()}
    save_file(old, run.checkpoint_path, metadata)


def test_a_run_of_schema_1_is_converted_when_it_is_read(
    tmp_path: Path, scene: Scene, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["motion.count=16", "density.reset_opacity=0.01", "layers=[]"]
    preset, splats = load_preset("dnerf", None, options), splats_of(9)
    run = create_run(tmp_path / "run", "dnerf", preset, FACTS, scene)
    model = start_model(splats, preset.motion, (), FACTS, torch.Generator().manual_seed(0))
    points = "motion.control_points"
    tensors = dict(model.tensors())
    further = (f"last.{points}", f"adam.first.{points}", f"adam.second.{points}")
    tensors |= {name: torch.full((16, 3), float(i)) for i, name in enumerate(further)}
    state = {"adam_steps": {points: 7}, "adam_restarts": {points: 3}, "dropped": 1, "events": {}}
    run.save(Checkpoint(7, 1.0, 1.0, tensors, state))
    expected = run.load()
    as_before_version_0_2(run)
    opened = open_run(run.root)
    found = opened.load()
    assert opened == run and found.state == expected.state == state
    assert found.tensors.keys() == expected.tensors.keys() and points in found.tensors
    assert all(torch.equal(found.tensors[name], t) for name, t in expected.tensors.items())
    loaded, _ = opened.load_model()
    assert torch.equal(loaded.tensors()[points], model.tensors()[points])
    assert capsys.readouterr() == ("", "")  # a hint is for what the user has just written


def test_a_state_without_a_list_of_events_is_converted() -> None:
    state = {"rounds": 4, "resets": 1, "adam_steps": {"motion.nodes": 2}, "queue": [3]}
    assert earlier.present_state(state, "control_points") == {
        "adam_steps": {"motion.control_points": 2},
        "adam_restarts": {},
        "dropped": 0,
        "queue": [3],
        "events": {
            "density": {"rounds": 4},
            "opacity_reset": {"count": 1},
            "thinning": {"count": 0},
        },
    }
    kept = earlier.present_state(state, "of_a_plugin")["adam_steps"]
    assert kept == {"motion.nodes": 2}
