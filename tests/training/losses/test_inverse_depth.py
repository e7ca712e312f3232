"""The term that pushes away what the pictures leave open: closed forms, gradients, its training."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from seam_checks import assert_trains_the_same_in_all_ways
from torch import Tensor
from training_checks import preset_of
from view_checks import SIZE, camera_at

from gsdmsr_cli.drawing.depth import draw_depth
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.scene import View
from gsdmsr_cli.training.losses import Seen, start_term
from gsdmsr_cli.training.trainer import check_plugins

DISTANCE = 4.0
"""Of the camera from the origin, at which it looks along y."""


def splats_at(
    *places: tuple[float, float, float], opacity: float = 6.0, size: float = 1.0
) -> Splats:
    """Return splats at places, whose opacity is a logit."""
    n = len(places)
    return Splats(
        means=torch.tensor(places),
        quats=torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(n, 1),
        log_scales=torch.full((n, 3), math.log(0.3 * size)),
        logit_opacities=torch.full((n,), opacity),
        sh=torch.zeros(n, 1, 3),
    )


def value_of(splats: Splats, mask: Tensor | None = None, distance: float = DISTANCE) -> Tensor:
    camera = camera_at(0, -distance, 0)
    view = View("0", camera, 0.0, "train", Path())

    class Known:
        def signal(self, view: View, name: str) -> Tensor | None:
            return mask

    moment, pictures = Moment(splats), Known()
    frame = draw_depth(moment, camera, best_engine("cpu"))
    target = torch.zeros(3, SIZE, SIZE, dtype=torch.uint8)
    unread: Any = pictures
    return start_term({"name": "inverse_depth"})(
        Seen(view, unread, camera, target, Instant(0.0), moment, frame=frame)
    )


@pytest.mark.parametrize("opacity", [6.0, -1.0])
def test_one_splat_counts_with_its_depth_however_opaque(opacity: float) -> None:
    value = value_of(splats_at((0.0, 0.0, 0.0), opacity=opacity))
    assert float(value) == pytest.approx(math.log(1 / DISTANCE), abs=1e-5)


def test_it_is_of_the_mean_over_what_is_covered() -> None:
    """Two of the same splats, side by side on the screen, at the distances 4 and 2."""
    both = splats_at((-1.0, 0.0, 0.0), (0.5, -2.0, 0.0))
    both.log_scales[1] -= math.log(2)
    assert float(value_of(both)) == pytest.approx(math.log((1 / 4 + 1 / 2) / 2), abs=2e-2)
    half = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    half[:, : SIZE // 2] = True
    larger = half.repeat_interleave(3, 0).repeat_interleave(3, 1)  # of a picture that was shrunk
    for mask in (half, larger):
        assert float(value_of(both, mask)) == pytest.approx(math.log(1 / 4), abs=1e-4)


@pytest.mark.parametrize("unit", [1.0, 10.0])
def test_its_gradient_moves_away_by_a_share_of_the_distance(unit: float) -> None:
    splats = splats_at((0.0, 0.0, 0.0), size=unit).map(torch.nn.Parameter)
    value_of(splats, distance=unit * DISTANCE).backward()
    expected = torch.tensor([[0.0, -1 / (unit * DISTANCE), 0.0]])
    assert splats.means.grad is not None
    torch.testing.assert_close(splats.means.grad, expected, rtol=1e-3, atol=1e-5)


def test_fog_before_a_wall_becomes_transparent() -> None:
    fog = splats_at((0.0, -2.0, 0.0), (0.0, 0.0, 0.0), opacity=0.0).map(torch.nn.Parameter)
    value_of(fog).backward()
    gradient = fog.logit_opacities.grad
    assert gradient is not None and gradient[0] > 0.01, "of the near one, which then falls"
    assert gradient[1] < 0, "and what is behind it gains"


def test_nothing_in_view_counts_for_nothing() -> None:
    hidden = splats_at((0.0, 0.0, 0.0), opacity=-9.0).map(torch.nn.Parameter)
    value = value_of(hidden)
    value.backward()
    assert value.item() == 0.0
    for tensor in hidden.tensors().values():
        assert tensor.grad is None or not tensor.grad.any()
    none = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    assert float(value_of(splats_at((0.0, 0.0, 0.0)), none)) == 0.0


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ("factor: 0", "factor is 0"),
        ("until: 2", "until is 2.0; allowed: a progress from"),
        ("every: 0", "every is 0; allowed: 1 or more"),
        ("shrink: 0", "shrink is 0; allowed: 1 or more"),
    ],
)
def test_bad_options_are_named(options: str, problem: str) -> None:
    with pytest.raises(UsageError, match=problem):
        check_plugins(preset_of(f"losses.terms=[{{name: inverse_depth, {options}}}]"))


def test_it_trains_with_workers_without_and_resumed(rig: Path, tmp_path: Path) -> None:
    term = "losses.terms=[{name: inverse_depth, factor: 0.1, until: 0.8, every: 3}]"
    trainer = assert_trains_the_same_in_all_ways(rig, tmp_path, term, "density.prune_scale=10.0")
    (only,) = trainer.renderer.terms
    assert [only.weight(progress) for progress in (0.0, 0.79, 0.8)] == [0.1, 0.1, 0.0]
