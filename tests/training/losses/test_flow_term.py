"""The flow term: what is drawn against what the pictures say, its gradient, its training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from seam_checks import assert_trains_the_same_in_all_ways
from torch import Tensor
from training_checks import preset_of, trainer_of
from view_checks import SIZE, camera_at

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.scene import View
from gsdmsr_cli.training.losses import Seen, start_term
from gsdmsr_cli.training.losses.flow import Flow
from gsdmsr_cli.training.trainer import check_plugins

TERM = "losses.terms=[{name: flow, factor: 0.1, since: 0.2}]"


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
    views = [View(str(time), camera, time, "train", Path()) for time in (0.0, 1.0)]
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
    target = torch.zeros(3, SIZE, SIZE, dtype=torch.uint8)
    pictures: Any = Known()
    instants = Instant(0.0), Moment(now), Instant(1.0), Moment(then)
    return term(Seen(views[0], pictures, camera, target, *instants))


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
