"""What moves is masked by a model of what stands still, and by the flow that contradicts it."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import moving_room
import numpy as np
import pytest
from datasets import noise, write_picture
from test_prepare import prepare

from gsdmsr_cli.capture import second_masks
from gsdmsr_cli.capture.masks import read_mask
from gsdmsr_cli.capture.second_masks import (
    DIFFERENT,
    Standing,
    beyond,
    on_path,
    with_masks,
    write_second_masks,
)
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.imaging import read_image
from gsdmsr_cli.scene.lens import Lens
from gsdmsr_cli.scene.scene import MOVING, Scene, View

WIDTH, FRAMES = 160, 48


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """Exposures drift on the camera's path; test views are beside it."""
    folder = tmp_path_factory.mktemp("room") / "scene"
    moving_room.write_capture(folder, WIDTH, FRAMES, pixels=0.0, drift=0.2, seed=0)
    return read_scene(folder)


def shown(view: View) -> np.ndarray:
    """Return the view's picture, (H, W, 3) in [0, 1]."""
    return (read_image(view.image_path)[..., :3] / 255).astype(np.float32)


@pytest.fixture(scope="module")
def empty_room(scene: Scene) -> Standing:
    """The room as each camera sees it without what moves."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(moving_room, "THINGS", {})
        drawn = {view.name: moving_room._shot(view.camera, 0)[0] / 255 for view in on_path(scene)}
    return Standing("", lambda view: drawn[view.name].astype(np.float32), shown)


def overlap(scene: Scene, standing: Standing, folder: Path) -> float:
    """Return the mean overlap (IoU) of the masks that are written and the true ones."""
    folder.mkdir()
    told: list[tuple[int, int]] = []
    write_second_masks(folder, scene, standing, lambda done, total: told.append((done, total)))
    assert told == [(done, FRAMES) for done in range(1, FRAMES + 1)]
    found = []
    for view, masked in zip(scene.views, with_masks(scene, folder).views, strict=True):
        if view.split == "test":
            assert masked is view
            continue
        true, own = (read_mask(of.signals[MOVING]) for of in (view, masked))
        found.append((true & own).sum() / (true | own).sum())
    return float(np.mean(found))


def test_both_together_mask_more_than_each(
    scene: Scene, empty_room: Standing, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    both = overlap(scene, empty_room, tmp_path / "both")
    monkeypatch.setattr(second_masks, "ENOUGH", 0.999)
    with monkeypatch.context() as patch:
        patch.setattr(second_masks, "DIFFERENT", np.inf)
        by_flow = overlap(scene, empty_room, tmp_path / "flow")
    assert both > 0.85 and both > by_flow + 0.05


def test_an_exposure_and_half_a_pixel_are_no_difference_and_another_colour_is() -> None:
    rng = np.random.default_rng(0)
    coarse = rng.uniform(0.2, 0.8, (6, 8, 3))
    drawn = np.kron(coarse, np.ones((8, 8, 1))).astype(np.float32)
    true = np.roll(drawn, 1, axis=1) @ np.diag([0.9, 1.0, 0.7]).astype(np.float32) + 0.05
    same = beyond(drawn, true)[:, 1:]  # the first column has come round from the other side
    assert same.max() < DIFFERENT
    true[10:20, 30:40] = (1, 0, 0)
    changed = beyond(drawn, true)
    assert changed[12:18, 32:38].min() > 3 * DIFFERENT
    changed[9:21, 29:41] = 0
    assert np.median(changed[:, 1:]) < 0.1 * DIFFERENT


def refusal(scene: Scene) -> str:
    with pytest.raises(DataError) as caught:
        on_path(scene)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_what_no_flow_can_be_found_in_is_refused(scene: Scene) -> None:
    assert [view.time for view in on_path(scene)] == pytest.approx(np.linspace(0, 1, FRAMES))
    first, *others = scene.views
    assert first.split == "train"
    twice = replace(scene, views=(first, *scene.views))
    assert "43 train pictures of 42 moments" in refusal(twice)
    camera = first.camera
    lens = Lens(camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height)
    assert "through a lens" in refusal(replace(scene, views=(replace(first, lens=lens), *others)))
    smaller = replace(first, camera=camera.resized(80, 60))
    assert "80 x 60 and 160 x 120" in refusal(replace(scene, views=(smaller, *others)))


def train(scene: Path, run: Path, *options: str) -> None:
    line = [sys.executable, "-m", "gsdmsr_cli", "train", "--data", str(scene), "--out", str(run)]
    ended = subprocess.run([*line, *options], capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr


def test_a_scene_gets_the_masks_of_a_run_of_what_stands_still(tmp_path: Path) -> None:
    given, out = tmp_path / "scene", tmp_path / "masked"
    moving_room.write_capture(given, 64, 8, pixels=0.0, drift=0.0, seed=0)
    few = "--steps", "20", "--threads", "1", "--set", "splats.count=300"
    train(given, tmp_path / "moving", "--preset", "video", *few)
    ended = prepare(given, "--masks-of", tmp_path / "moving", "--out", out)
    assert ended.returncode == 3 and "splats move (multiscale)" in ended.stderr, ended.stderr
    train(given, tmp_path / "run", "--preset", "static-video", *few)
    ended = prepare(given, "--masks-of", tmp_path / "run", "--out", out)
    assert ended.returncode == 0, ended.stderr
    before, after = read_scene(given), read_scene(out)
    assert after.bound == before.bound
    for old, new in zip(before.views, after.views, strict=True):
        assert new.image_path.read_bytes() == old.image_path.read_bytes()
        assert new.signals[MOVING].parent.parent == out
        if old.split == "test":
            assert new.signals[MOVING].read_bytes() == old.signals[MOVING].read_bytes()


def test_prepare_loads_nothing_that_draws_where_nothing_is_drawn() -> None:
    code = "import sys, gsdmsr_cli.commands.prepare; print('torch' in sys.modules)"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.stdout == "False\n", ended.stderr


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--auto-mask",), "are both given; drop one"),
        (("--masks", "."), "are both given; drop one"),
        ((), "has no cameras yet, and --masks-of needs a scene"),
    ],
)
def test_masks_of_a_run_need_a_scene_and_no_others(
    tmp_path: Path, more: tuple[str, ...], message: str
) -> None:
    write_picture(tmp_path / "film" / "p.png", noise(48, 64, 3, seed=0))
    given = tmp_path / "film", "--masks-of", tmp_path / "run", "--out", tmp_path / "out"
    ended = prepare(*given, *more)
    assert ended.returncode == 2 and message in ended.stderr, ended.stderr
    assert not (tmp_path / "out").exists()
