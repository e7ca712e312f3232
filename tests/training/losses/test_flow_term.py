"""The flow term: neighbouring views, what their pictures say, what is drawn, and its gradient."""

from __future__ import annotations

import errno
import io
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from datasets import write_picture
from seam_checks import assert_trains_the_same_in_all_ways
from torch import Tensor
from training_checks import preset_of, trainer_of

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.camera import Camera, look_at
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import View
from gsdmsr_cli.training.losses import Seen, _pictured_flow, start_term
from gsdmsr_cli.training.losses._pictured_flow import PicturedFlow, neighbours
from gsdmsr_cli.training.losses.flow import Flow
from gsdmsr_cli.training.trainer import check_plugins

SIZE = 64
UP = np.array([0.0, 0.0, 1.0])
TERM = "losses.terms=[{name: flow, factor: 0.1, since: 0.2}]"


def camera_at(x: float, y: float, z: float = 0.5, focal: float = 70.0) -> Camera:
    pose = look_at(np.array([x, y, z]), np.zeros(3), UP)
    return Camera(pose, focal, focal, SIZE / 2, SIZE / 2, SIZE, SIZE)


def views_of(cameras: Sequence[Camera], times: Sequence[float], folder: Path) -> list[View]:
    """Return a view of every camera at every time; all of a time have the same picture file."""
    return [
        View(f"{i}_{j}", camera, time, "train", folder / f"{j}.png")
        for i, camera in enumerate(cameras)
        for j, time in enumerate(times)
    ]


def test_neighbours_are_of_the_moments_beside_by_the_same_camera(tmp_path: Path) -> None:
    views = views_of([camera_at(4, 0), camera_at(0, 4)], [0.0, 0.5, 1.0], tmp_path)
    found = {view.name: [v.name for v in beside] for view, beside in neighbours(views).items()}
    assert found["0_0"] == ["0_1"] and found["0_1"] == ["0_0", "0_2"] and found["1_2"] == ["1_1"]


def test_a_camera_that_hardly_moves_has_neighbours_and_one_that_jumps_has_none(
    tmp_path: Path, tiny_scene: Path
) -> None:
    angles = np.linspace(0, 1, 40)  # by 1.5 degrees from moment to moment
    walk = [
        View(str(i), camera_at(4 * np.cos(a), 4 * np.sin(a)), i / 39, "train", tmp_path / "0.png")
        for i, a in enumerate(angles)
    ]
    assert [len(beside) for beside in neighbours(walk).values()] == [1, *38 * [2], 1]
    sparse = [replace(view, time=i / 4) for i, view in enumerate(walk[::8])]
    zoomed = [walk[0], replace(walk[1], camera=replace(walk[1].camera, fx=90.0))]
    jumping = read_scene(tiny_scene).split("train")
    for views in (sparse, zoomed, jumping):
        assert not any(neighbours(views).values())


def shifted_pictures(folder: Path, by: int = 3) -> tuple[Pictures, list[View]]:
    """Return two views of one camera; what the second shows lies ``by`` px further right."""
    noise = np.random.default_rng(0).normal(size=(SIZE, SIZE + 8, 3))
    smooth = noise
    for axis in (0, 1):
        smooth = sum(np.roll(smooth, s, axis) for s in (-2, -1, 0, 1, 2))
    texture = np.clip(128 + 12 * smooth, 0, 255).astype(np.uint8)
    for name, left in (("0", by), ("1", 0)):
        write_picture(folder / f"{name}.png", texture[:, left : left + SIZE])
    return Pictures((1.0, 1.0, 1.0), 1, 1 << 20), views_of([camera_at(4, 0)], [0.0, 1.0], folder)


def test_pictures_say_how_far_what_they_show_has_gone(tmp_path: Path) -> None:
    pictures, (first, second) = shifted_pictures(tmp_path)
    for view, other, way in ((first, second, 3.0), (second, first, -3.0)):
        found = PicturedFlow().between(pictures, view, other)
        sure = np.isfinite(found).all(axis=2)
        assert found.shape == (SIZE, SIZE, 2) and sure[8:-8, 8:-8].mean() > 0.9
        np.testing.assert_allclose(np.median(found[sure], axis=0), [way, 0.0], atol=0.2)
        leaving = found[:, -1, 0] if way > 0 else found[:, 0, 0]
        assert np.isnan(leaving).all(), "what leaves the picture cannot be followed"


def test_flow_is_kept_in_files_and_made_again_where_one_is_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures, (first, second) = shifted_pictures(tmp_path)
    flow, again = PicturedFlow(), PicturedFlow()
    flow.folder = again.folder = tmp_path / "run" / "flow"
    expected = PicturedFlow().between(pictures, first, second)
    np.testing.assert_array_equal(flow.between(pictures, first, second), expected)
    assert not flow.folder.exists(), "nor is a run folder made that is not there"
    flow.folder.parent.mkdir()
    flow.between(pictures, first, second)
    (kept,) = flow.folder.iterdir()
    calls: list[int] = []
    whole = _pictured_flow.optical_flow
    monkeypatch.setattr(_pictured_flow, "optical_flow", lambda *a: calls.append(1) or whole(*a))
    for known in (flow, again):
        np.testing.assert_array_equal(known.between(pictures, first, second), expected)
    assert not calls
    whole_file = kept.read_bytes()
    spoilt = whole_file[:200] + bytes(9) + whole_file[209:]
    other = io.BytesIO()
    np.savez(other, flow=np.zeros((2, 2, 2), np.float16))
    for damaged in (whole_file[:-7], spoilt, b"", b"\x93NUMPY", other.getvalue()):
        kept.write_bytes(damaged)
        np.testing.assert_array_equal(again.between(pictures, first, second), expected)
        assert calls and kept.read_bytes() == whole_file
        calls.clear()


def test_pictures_too_small_for_a_flow_have_none(tmp_path: Path) -> None:
    _, (first, second) = shifted_pictures(tmp_path)
    small = Pictures((1.0, 1.0, 1.0), 3, 1 << 20)
    found = PicturedFlow().between(small, first, second)
    assert found.shape == (21, 21, 2) and np.isnan(found).all()


def splats_at(x: float) -> Splats:
    """Return one large opaque splat, ``x`` to the right of the middle of ``camera_at(0, -4)``."""
    return Splats(
        means=torch.tensor([[x, 0.0, 0.0]]),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        log_scales=torch.full((1, 3), -1.0),
        logit_opacities=torch.tensor([6.0]),
        sh=torch.zeros(1, 1, 3),
    )


def value_of(now: Splats, then: Splats, true: float, mask: Tensor | None = None) -> Tensor:
    """Return the term where the pictures say that everything goes ``true`` px to the right."""
    camera = camera_at(0, -4, 0)
    views = views_of([camera], [0.0, 1.0], Path())
    term, engine = start_term({"name": "flow"}), best_engine("cpu")
    assert isinstance(term, Flow) and term.begin(views, engine) is None

    class Known:
        def camera(self, view: View) -> Camera:
            return view.camera

        def signal(self, view: View, name: str) -> Tensor | None:
            return mask

    flow = np.zeros((SIZE, SIZE, 2), np.float32)
    flow[..., 0], flow[:, :2] = true, np.nan
    term._pictured.between = lambda *_: flow  # type: ignore[method-assign]
    frame = engine.rasterize(Moment(now), camera, torch.ones(3))
    target = torch.zeros(3, SIZE, SIZE, dtype=torch.uint8)
    pictures: Any = Known()
    instants = Instant(0.0), Moment(now), Instant(1.0), Moment(then)
    return term(Seen(views[0], pictures, camera, target, frame, *instants))


def test_its_value_is_the_mean_error_in_sides_of_the_picture() -> None:
    """A splat at distance 4 that goes 0.2 moves 70 * 0.2 / 4 = 3.5 px."""
    for true in (3.5, 1.5, 0.0):
        value = float(value_of(splats_at(0.0), splats_at(0.2), true))
        assert value == pytest.approx((3.5 - true) / SIZE, abs=1e-5)


def test_pixels_that_do_not_count_have_no_part() -> None:
    nowhere = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    assert float(value_of(splats_at(0.0), splats_at(0.2), 0.0, nowhere)) == 0.0


def test_its_gradient_moves_the_splats_and_nothing_else() -> None:
    now, then = (splats_at(x).map(torch.nn.Parameter) for x in (0.0, 0.1))
    value = value_of(now, then, 3.5)
    value.backward()
    # the error is 3.5 - 70 x / 4 px where x is how far it goes, in sides of 64 px
    expected = torch.tensor([[-70 / 4 / SIZE, 0.0, 0.0]])
    assert now.means.grad is not None and then.means.grad is not None
    torch.testing.assert_close(then.means.grad[:, 0], expected[:, 0], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(now.means.grad[:, 0], -expected[:, 0], rtol=1e-4, atol=1e-6)
    for splats in (now, then):
        for name in ("quats", "log_scales", "logit_opacities", "sh"):
            gradient = splats.tensors()[name].grad
            assert gradient is None or not gradient.any(), name


def test_it_trains_with_workers_without_and_resumed(rig: Path, tmp_path: Path) -> None:
    trainer = assert_trains_the_same_in_all_ways(
        rig, tmp_path, TERM, "motion={name: fourier}", "density.prune_scale=10.0"
    )
    assert trainer.renderer.notes == []
    (term,) = trainer.renderer.terms
    assert [term.weight(progress) for progress in (0.0, 0.19, 0.2, 0.9)] == [0.0, 0.0, 0.1, 0.1]


def test_it_says_so_where_no_camera_sees_two_moments_and_trains_without(tiny_scene: Path) -> None:
    trainer = trainer_of(tiny_scene, preset_of(TERM))
    (note,) = trainer.renderer.notes
    assert note.startswith("the term flow of the loss is left out: 0 of 12 train views have")
    assert all(term.weight(0.5) == 0.0 for term in trainer.renderer.terms)
    generator = torch.Generator().manual_seed(0)
    state = generator.get_state()
    assert trainer.renderer.other_times(trainer.views[0], [0.0, 1.0], generator) == (None,)
    assert torch.equal(generator.get_state(), state), "nor is chance spent on it"


def test_a_disk_that_takes_no_flow_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures, (first, second) = shifted_pictures(tmp_path)

    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(_pictured_flow.np, "savez_compressed", full)
    flow = PicturedFlow()
    flow.folder = tmp_path / "flow"
    assert np.isfinite(flow.between(pictures, first, second)).any()
    assert not list(flow.folder.iterdir())


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("factor: 0", "factor is 0.0; allowed: a number above 0"),
        ("since: 1.5", "since is 1.5; allowed: a progress from 0 to 1"),
        ("since: 0.5, until: 0.5", "until is 0.5; allowed: a progress above since, .* 0.5, up to"),
        ("factr: 1", "unknown key 'factr'; did you mean 'factor'?"),
    ],
)
def test_options_out_of_range_are_refused_in_one_line(options: str, message: str) -> None:
    with pytest.raises(UsageError, match=message) as caught:
        check_plugins(preset_of(f"losses.terms=[{{name: flow, {options}}}]"))
    assert "\n" not in str(caught.value)
