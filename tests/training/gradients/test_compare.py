"""Gradients of views some of whose pixels do not count."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from datasets import noise
from torch import Tensor
from training_checks import counted_ways_back, preset_of, trainer_of

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.measure import Measure
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.model.model import STORED_AS, Model
from gsdmsr_cli.ops.photometric import photometric_loss_twin
from gsdmsr_cli.ops.photometric.twin import distances
from gsdmsr_cli.raster import load_engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.training.gradients.compare import Moving, compare
from gsdmsr_cli.training.gradients.inliers import inliers
from gsdmsr_cli.training.gradients.phase import ViewGradients
from gsdmsr_cli.training.trainer import Trainer

BACKGROUND = torch.tensor([1.0, 1.0, 1.0])


@pytest.fixture
def trainer(tiny_scene: Path) -> Trainer:
    return trainer_of(tiny_scene, preset_of())


def half(height: int, width: int) -> Tensor:
    """A mask of the left half."""
    return (torch.arange(width) < width // 2).expand(height, width)


def compared(
    trainer: Trainer,
    target: Tensor,
    ssim: float,
    counted: Tensor | None,
    engine: str = "cpu",
    weights: Tensor | None = None,
    normal: float = 1.0,
    screens: bool = True,
    further: Tensor | None = None,
    moving: Moving | None = None,
    quadratic: float = 0.0,
) -> ViewGradients:
    model: Model = trainer.model
    camera: Camera = trainer.renderer.pictures.camera(trainer.views[0])
    return compare(
        load_engine(engine), model, Moment(model.splats), Instant(0.0), camera, BACKGROUND, target,
        Measure(ssim, quadratic), 1, weights, counted, normal, screens, further, moving,
    )  # fmt: skip


def gradients(found: ViewGradients) -> list[Tensor]:
    return [gradient for gradient in (*found.gradients, found.on_screen) if gradient is not None]


def drawn(trainer: Trainer) -> Frame:
    """What the engine without tiles draws of the first view."""
    camera: Camera = trainer.renderer.pictures.camera(trainer.views[0])
    moment = Moment(trainer.model.splats)
    return load_engine("reference").rasterize(moment, camera, BACKGROUND, 1)


@pytest.mark.parametrize("ssim", [0.0, 0.2])
@pytest.mark.parametrize("engine", ["cpu", "reference"])
def test_pixels_that_do_not_count_are_taken_for_right(
    trainer: Trainer, ssim: float, engine: str
) -> None:
    """Also by windows that reach there: the loss is that of a picture with the true ones there."""
    target = trainer.renderer.pictures.load(trainer.views[0])
    counted = half(*target.shape[1:])
    true = target.permute(1, 2, 0).double() / 255
    rgb = torch.where(counted[..., None], drawn(trainer).rgb.double(), true)
    expected = photometric_loss_twin(rgb, target, Measure(ssim)).item()
    found = compared(trainer, target, ssim, counted, engine).loss.item()
    assert found == pytest.approx(expected, rel=1e-4)


@pytest.mark.parametrize("box", [(0, 9, 0, 7), (19, 30, 22, 25), (30, 48, 40, 48), (0, 48, 0, 48)])
@pytest.mark.parametrize("ssim", [0.0, 0.2])
@pytest.mark.parametrize("engine", ["cpu", "reference"])
def test_what_moves_counts_again_as_if_all_else_were_right(
    trainer: Trainer, ssim: float, engine: str, box: tuple[int, int, int, int]
) -> None:
    """Loss and gradients, whatever part of the picture has to be looked at for that."""
    target = trainer.renderer.pictures.load(trainer.views[0])
    top, bottom, left, right = box
    mask = torch.zeros(target.shape[1:], dtype=torch.bool)
    mask[top:bottom, left:right] = True
    mask[top + 3, left + 2] = False
    frame = drawn(trainer)
    rgb, true = frame.rgb.double(), target.permute(1, 2, 0).double() / 255
    alone = torch.where(mask[..., None], rgb, true)
    of_all, of_moving = (photometric_loss_twin(x, target, Measure(ssim)) for x in (rgb, alone))
    loss = of_all + 3 * of_moving
    wanted = [*trainer.model.trained().values(), frame.means2d]
    expected = torch.autograd.grad(loss, wanted, allow_unused=True)
    found = compared(trainer, target, ssim, None, engine, moving=Moving(mask, 3.0))
    assert found.loss.item() == pytest.approx(loss.item(), rel=1e-4)
    for one, other in zip((*found.gradients, found.on_screen), expected, strict=True):
        assert (one is None) == (other is None)
        if one is not None and other is not None:
            atol = 2e-3 * float(other.abs().max()) + 1e-8
            torch.testing.assert_close(one, other, rtol=1e-2, atol=atol)


@pytest.mark.parametrize("quadratic", [0.0, 0.2])
def test_what_moves_counts_more_in_tiles_too(trainer: Trainer, quadratic: float) -> None:
    target = trainer.renderer.pictures.load(trainer.views[0])
    weights, mask = torch.tensor([0.0, 4.5, 0.5, 2.0, 0, 0, 0, 9.0, 1.0]), half(48, 48)
    differences = drawn(trainer).rgb - target.permute(1, 2, 0) / 255
    errors = distances(differences, quadratic).sum(dim=2) * (1 + 3 * mask)
    per_tile = errors.detach().view(3, 16, 3, 16).sum(dim=(1, 3)).flatten()
    found = compared(
        trainer, target, 0.0, None, weights=weights, moving=Moving(mask, 3.0), quadratic=quadratic
    )
    expected = float((per_tile * weights).sum() / target.numel())
    assert found.loss.item() == pytest.approx(expected, rel=1e-4)
    assert found.tile_errors is not None
    drawn_tiles = per_tile * (weights > 0)
    torch.testing.assert_close(found.tile_errors.float(), drawn_tiles, rtol=1e-4, atol=1e-4)


def test_if_nothing_moves_nothing_counts_more(trainer: Trainer) -> None:
    target = trainer.renderer.pictures.load(trainer.views[0])
    nothing = torch.zeros(target.shape[1:], dtype=torch.bool)
    for ssim in (0.0, 0.2):
        plain = compared(trainer, target, ssim, ~nothing)
        found = compared(trainer, target, ssim, None, moving=Moving(nothing, 3.0))
        assert found.loss.item() == pytest.approx(plain.loss.item(), rel=1e-6)


@pytest.mark.parametrize("engine", ["cpu", "reference"])
def test_the_statistic_under_tiles_is_of_those_drawn_whatever_their_weights(
    trainer: Trainer, engine: str
) -> None:
    """Tiles of 16 px, three in a row; the loss has the weights, the gradient on the screen none."""
    target = trainer.renderer.pictures.load(trainer.views[0])
    weights = torch.tensor([0.0, 4.5, 0.5, 2.0, 0.0, 0.0, 0.0, 9.0, 1.0])
    frame = drawn(trainer)
    errors = (frame.rgb - target.permute(1, 2, 0) / 255).abs().sum(dim=2)
    spread = weights.view(3, 3).repeat_interleave(16, 0).repeat_interleave(16, 1)
    loss = (errors * spread).sum() / target.numel()
    seen = (errors * (spread > 0)).sum() / target.numel()
    (on_screen,) = torch.autograd.grad(seen, frame.means2d)
    found = compared(trainer, target, 0.0, None, engine, weights)
    assert found.loss.item() == pytest.approx(loss.item(), rel=1e-4)
    largest = float(on_screen.abs().max())
    torch.testing.assert_close(found.on_screen, on_screen, rtol=1e-3, atol=1e-4 * largest)
    assert found.tile_errors is not None
    per_tile = errors.detach().view(3, 16, 3, 16).sum(dim=(1, 3)).flatten() * (weights > 0)
    torch.testing.assert_close(found.tile_errors.float(), per_tile, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("engine", ["cpu", "reference"])
@pytest.mark.parametrize("tiles", [False, True], ids=["", "tiles"])
def test_the_picture_is_gone_back_through_again_only_for_a_statistic_of_its_own(
    trainer: Trainer, engine: str, tiles: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That is where tiles are weighted and somebody asks for the gradients on the screen."""
    target = trainer.renderer.pictures.load(trainer.views[0])
    weights = torch.tensor([0.0, 4.5, 0.5, 2.0, 0.0, 0.0, 0.0, 9.0, 1.0]) if tiles else None
    times = counted_ways_back(monkeypatch)
    found = []
    for screens in (True, False):
        times.clear()
        found.append(compared(trainer, target, 0.0, None, engine, weights, 1.0, screens))
        assert len(times) == (2 if tiles and screens and engine == "reference" else 1)
    with_screens, without = found
    for gradient, same in zip(with_screens.gradients, without.gradients, strict=True):
        assert (gradient is None and same is None) or torch.equal(gradient, same)
    assert with_screens.on_screen.any()


@pytest.mark.parametrize("engine", ["cpu", "reference"])
def test_what_is_added_to_the_loss_has_a_part_in_all_but_the_statistic(
    trainer: Trainer, engine: str
) -> None:
    target = trainer.renderer.pictures.load(trainer.views[0])
    more = 0.01 * trainer.model.splats.means.square().sum()
    plain = compared(trainer, target, 0.2, None, engine)
    found = compared(trainer, target, 0.2, None, engine, further=more)
    assert float(found.loss) == pytest.approx(float(plain.loss + more.detach()))
    assert torch.equal(found.on_screen, plain.on_screen)
    for name, own, other in zip(
        trainer.model.trained(), plain.gradients, found.gradients, strict=True
    ):
        if own is None or other is None:
            assert own is other
            continue
        added = 0.02 * trainer.model.splats.means if name == f"{STORED_AS}means" else 0.0
        torch.testing.assert_close(other, own + added)


def test_what_does_not_count_may_be_anything(trainer: Trainer) -> None:
    """But for windows of SSIM, which see the true pixels there on both sides."""
    ssim = 0.0
    target = trainer.renderer.pictures.load(trainer.views[0])
    counted = half(*target.shape[1:])
    other = torch.where(counted, target, torch.from_numpy(noise(48, 48, 3)).permute(2, 0, 1))
    one, same = (compared(trainer, picture, ssim, counted) for picture in (target, other))
    plain = compared(trainer, other, ssim, None)
    assert one.loss == same.loss != plain.loss
    for found, expected in zip(gradients(same), gradients(one), strict=True):
        assert torch.equal(found, expected)
    assert one.tile_errors is not None and same.tile_errors is not None
    assert torch.equal(one.tile_errors, same.tile_errors)


@pytest.mark.parametrize("ssim", [0.01, 1.0])
def test_tiles_are_not_weighted_where_ssim_counts(trainer: Trainer, ssim: float) -> None:
    target = trainer.renderer.pictures.load(trainer.views[0])
    with pytest.raises(ValueError, match="tiles cannot be weighted where SSIM counts"):
        compared(trainer, target, ssim, None, "cpu", torch.ones(9))


@pytest.mark.parametrize("ssim", [0.0, 0.2])
@pytest.mark.parametrize("engine", ["cpu", "reference"])
def test_if_all_counts_nothing_changes(trainer: Trainer, ssim: float, engine: str) -> None:
    target = trainer.renderer.pictures.load(trainer.views[0])
    everything = torch.ones(target.shape[1:], dtype=torch.bool)
    masked = compared(trainer, target, ssim, everything, engine)
    plain = compared(trainer, target, ssim, None)
    assert masked.loss.item() == pytest.approx(plain.loss.item(), rel=1e-4)
    for found, expected in zip(gradients(masked), gradients(plain), strict=True):
        scale = float(expected.abs().max())
        atol = 2e-3 * scale + 1e-8  # turns of round splats have no gradient but rounding errors
        torch.testing.assert_close(found, expected, atol=atol, rtol=1e-2)


def test_if_nothing_counts_there_is_nothing_to_learn(trainer: Trainer) -> None:
    target = trainer.renderer.pictures.load(trainer.views[0])
    found = compared(trainer, target, 0.2, torch.zeros(target.shape[1:], dtype=torch.bool))
    assert found.loss.item() == pytest.approx(0, abs=1e-5)  # SSIM in float32
    assert all(not gradient.any() for gradient in gradients(found))


@pytest.mark.parametrize("ssim", [0.0, 0.2])
def test_areas_with_unusual_errors_do_not_count(trainer: Trainer, ssim: float) -> None:
    """A patch of another colour, as of something that goes past, changes no gradient."""
    target = trainer.renderer.pictures.load(trainer.views[0]).clone()
    target[:, 8:40, 8:40] = 255 - target[:, 8:40, 8:40]
    counted = inliers(drawn(trainer).rgb, target, 0.5)
    assert not counted.all()
    expected = compared(trainer, target, ssim, counted)
    found = compared(trainer, target, ssim, None, normal=0.5)
    assert found.loss == expected.loss < compared(trainer, target, ssim, None).loss
    for one, other in zip(gradients(found), gradients(expected), strict=True):
        assert torch.equal(one, other)
