"""How pictures are compared: closed forms, averages, and reasons for what is missing."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from datasets import noise, write_picture
from motion_checks import model_of, started
from torch import Tensor

from gsdmsr_cli.evaluation import protocol
from gsdmsr_cli.evaluation.metrics import Missing, psnr, quantize, ssim
from gsdmsr_cli.evaluation.protocol import (
    ViewRenderer,
    average,
    score,
    score_views,
    storage,
)
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.raster import load_engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import View

BACKGROUND = (0.2, 0.4, 0.6)


def grey(level: float) -> Tensor:
    return torch.full((12, 14, 3), level)


def test_scores_of_the_true_picture_itself() -> None:
    picture = torch.from_numpy(noise(12, 14, 3).astype(np.float32)) / 255
    scores = score(picture, picture, {})
    assert scores == {
        "psnr": 100.0, "psnr_float": 100.0, "psnr_fitted": 100.0, "ssim": pytest.approx(1.0),
    }  # fmt: skip


def test_psnr_is_of_rounded_pictures_and_psnr_float_is_not() -> None:
    """101.4 / 255 rounds to 101 / 255; the true picture is 100 / 255."""
    scores = score(grey(101.4 / 255), grey(100 / 255), {})
    assert scores["psnr"] == pytest.approx(20 * math.log10(255), abs=1e-3)
    assert scores["psnr_float"] == pytest.approx(20 * math.log10(255 / 1.4), abs=1e-3)


def test_ssim_is_of_rounded_pictures() -> None:
    """Waves of 0.4 of a level are gone after rounding, and with them all that differs."""
    level = 100 + 0.4 * torch.sin(torch.arange(14.0))
    drawn = (level / 255).expand(12, 14)[..., None].expand(12, 14, 3)
    true = grey(100 / 255)
    assert score(drawn, true, {})["ssim"] == pytest.approx(1.0, abs=1e-6)
    assert ssim(drawn, true) < 1 - 1e-5


def test_drawn_values_outside_are_clamped() -> None:
    assert score(grey(7.0), grey(1.0), {})["psnr_float"] == 100.0
    assert score(grey(-3.0), grey(0.0), {})["psnr"] == 100.0


def test_a_picture_with_nan_has_no_scores() -> None:
    drawn = grey(0.5)
    drawn[3, 4, 1] = math.nan
    assert score(drawn, grey(0.5), {}) == dict.fromkeys(
        ("psnr", "psnr_float", "psnr_fitted", "ssim")
    )


def test_lpips_is_of_the_rounded_picture_and_none_where_missing() -> None:
    seen = []

    def net(drawn: Tensor, true: Tensor) -> float:
        seen.append((drawn, true))
        return 0.25

    drawn, true = grey(101.4 / 255), grey(0.0)
    nets = {"lpips_alex": net, "lpips_vgg": Missing("no weights", ())}
    scores = score(drawn, true, nets)  # type: ignore[arg-type]
    assert (scores["lpips_alex"], scores["lpips_vgg"]) == (0.25, None)
    assert torch.equal(seen[0][0], grey(101 / 255)) and seen[0][1] is true


def test_averages_are_means_over_frames_and_none_where_a_frame_has_none() -> None:
    frames = [{"psnr": 20.0, "ssim": 0.5}, {"psnr": 31.0, "ssim": None}, {"psnr": 30.0, "ssim": 1}]
    assert average(frames) == {"psnr": 27.0, "ssim": None}


def test_frames_that_do_not_name_a_metric_do_not_count_for_it() -> None:
    """A frame in which nothing moves says nothing of how well motion is met."""
    frames = [{"psnr": 20.0}, {"psnr": 30.0, "psnr_moving": 12.0}]
    assert average(frames) == {"psnr": 25.0, "psnr_moving": 12.0}


def test_parts_of_a_picture_are_scored_and_empty_ones_left_out() -> None:
    drawn, true = (
        torch.rand(12, 14, 3, generator=torch.Generator().manual_seed(s)) for s in (1, 2)
    )
    left = torch.zeros(12, 14, dtype=torch.bool)
    left[:, :5] = True
    scores = score(drawn, true, {}, {"moving": left, "static": ~left, "masked": left & ~left})
    assert scores.keys() == {
        "psnr", "psnr_float", "psnr_fitted", "ssim",
        "psnr_moving", "ssim_moving", "psnr_static", "ssim_static",
    }  # fmt: skip
    rounded = quantize(drawn)
    assert scores["psnr_moving"] == pytest.approx(psnr(rounded[:, :5], true[:, :5]), abs=1e-9)
    assert scores["psnr_static"] == pytest.approx(psnr(rounded[:, 5:], true[:, 5:]), abs=1e-9)
    assert scores["ssim_moving"] == ssim(rounded, true, left)
    drawn[3, 2] = math.nan
    scores = score(drawn, true, {}, {"moving": left, "static": ~left})
    assert scores["psnr_moving"] is None and scores["psnr_static"] is not None


def test_every_missing_value_has_its_reason() -> None:
    nets = {"lpips_alex": None, "lpips_vgg": Missing("no weights", ("a", "b")), "lpips_x": None}
    aggregate = {"psnr": 20.0, "lpips_alex": 0.5, "lpips_vgg": None, "lpips_x": None}
    found = protocol.with_reasons(aggregate, nets)  # type: ignore[arg-type]
    assert found == {
        "psnr": 20.0,
        "lpips_alex": {"value": 0.5, "reason": None, "searched": []},
        "lpips_vgg": {"value": None, "reason": "no weights", "searched": ["a", "b"]},
        "lpips_x": {"value": None, "reason": "not a number in at least one frame", "searched": []},
    }
    json.dumps(found, allow_nan=False)


@pytest.fixture
def renderer() -> ViewRenderer:
    """One grey splat that covers the picture, and its background."""
    splats = Splats(
        means=torch.zeros(1, 3),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        log_scales=torch.full((1, 3), math.log(50.0)),
        logit_opacities=torch.zeros(1),
        sh=torch.zeros(1, 1, 3),
    )
    pictures = Pictures(BACKGROUND, 2, 10**6)
    engine, background = load_engine("reference"), torch.tensor(BACKGROUND)
    return ViewRenderer(model_of(splats, started("static")), engine, pictures, background)


def view_of(path: Path, name: str) -> View:
    pose = np.eye(4)
    pose[2, 3] = 4.0
    camera = Camera(pose, 20.0, 20.0, 10.0, 8.0, 20, 16)
    return View(name, camera, 0.5, "test", path / f"{name}.png")


def test_a_studio_draws_and_loads_at_the_size_of_its_pictures(
    renderer: ViewRenderer, tmp_path: Path
) -> None:
    write_picture(tmp_path / "a.png", np.full((16, 20, 3), 51, np.uint8))
    view = view_of(tmp_path, "a")
    drawn, true = renderer.draw(view), renderer.true(view)
    assert drawn.shape == true.shape == (8, 10, 3)
    assert not drawn.requires_grad
    torch.testing.assert_close(true, torch.full((8, 10, 3), 0.2))
    expected = 0.5 * 0.5 + 0.5 * torch.tensor(BACKGROUND)  # half opaque, half grey
    torch.testing.assert_close(drawn, expected.expand(8, 10, 3), atol=5e-3, rtol=0)


def write_mask(path: Path, white: tuple[slice, slice]) -> Path:
    pixels = np.zeros((16, 20, 1), np.uint8)
    pixels[white] = 255
    write_picture(path, pixels)
    return path


def test_what_moves_is_a_part_of_what_counts(renderer: ViewRenderer, tmp_path: Path) -> None:
    view = view_of(tmp_path, "a")
    assert renderer.parts(view) == {}
    left, above = (slice(None), slice(0, 10)), (slice(0, 4), slice(None))
    view = replace(view, signals={"moving": write_mask(tmp_path / "moves.png", left)})
    rows, columns = torch.meshgrid(torch.arange(8), torch.arange(10), indexing="ij")
    parts = renderer.parts(view)
    assert parts.keys() == {"moving", "static"}
    assert torch.equal(parts["moving"], columns < 5)
    assert torch.equal(parts["static"], columns >= 5)
    mask = write_mask(tmp_path / "counts.png", above)
    parts = renderer.parts(replace(view, signals={**view.signals, "mask": mask}))
    assert torch.equal(parts["masked"], rows < 2)
    assert torch.equal(parts["moving"], (rows < 2) & (columns < 5))
    assert torch.equal(parts["static"], (rows < 2) & (columns >= 5))


def test_another_background_lies_behind_drawn_and_true_pictures(
    renderer: ViewRenderer, tmp_path: Path
) -> None:
    write_picture(tmp_path / "a.png", np.full((16, 20, 4), (255, 255, 255, 51), np.uint8))
    view, black = view_of(tmp_path, "a"), renderer.over((0.0, 0.0, 0.0))
    drawn = torch.full((8, 10, 3), 0.25)
    torch.testing.assert_close(black.draw(view), drawn, atol=5e-3, rtol=0)
    torch.testing.assert_close(black.true(view), torch.full((8, 10, 3), 0.2))
    assert renderer.true(view)[0, 0, 2] == pytest.approx(0.2 + 0.8 * 0.6, abs=0.5 / 255)


def test_views_are_scored_in_order_and_told(renderer: ViewRenderer, tmp_path: Path) -> None:
    views = [view_of(tmp_path, name) for name in "ab"]
    for view, level in zip(views, (77, 200), strict=True):
        write_picture(view.image_path, np.full((16, 20, 3), level, np.uint8))
    told: list[int] = []
    scored = score_views(renderer, views, {}, told.append)
    assert [view for view, _ in scored] == views and told == [1, 2]
    for view, scores in scored:
        assert scores == score(renderer.draw(view), renderer.true(view), {})
    assert scored[0][1]["psnr"] != scored[1][1]["psnr"]


def test_a_missing_picture_is_told(renderer: ViewRenderer, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"b\.png"):
        score_views(renderer, [view_of(tmp_path, "b")], {}, lambda done: None)


def test_storage_counts_the_bytes_of_each_part() -> None:
    tensors = {
        "splats.means": torch.zeros(10, 3),
        "splats.quats": torch.zeros(10, 4),
        "motion.grid": torch.zeros(7, dtype=torch.float64),
        "adam.first.splats.means": torch.zeros(10, 3),
        "generator": torch.zeros(9, dtype=torch.uint8),
    }
    assert storage({name: tensor.nbytes for name, tensor in tensors.items()}) == {
        "splats_bytes": 280,
        "motion_bytes": 56,
        "training_state_bytes": 129,
    }
