"""Masks of what moves: what a splat shows of it, and that what shows nothing of it stands still."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import torch
from moving_room import write_capture
from seam_checks import assert_trains_the_same_in_all_ways
from training_checks import preset_of, trainer_of

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.model.model import MOTION, Model
from gsdmsr_cli.model.motion.static import Static
from gsdmsr_cli.raster import load_engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.training.population import Tick, start_events
from gsdmsr_cli.training.population.motion_masks import MotionMasks, shown_inside

BLACK = torch.zeros(3)
EVENTS = "events=[density, opacity_reset, {name: motion_masks, rounds: 4, until: 0.8}]"
PARTS = EVENTS, "density.prune_scale=1"
SIDE = 48


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A walk past a room in which two things move, with their masks."""
    folder = tmp_path_factory.mktemp("data") / "room"
    write_capture(folder, SIDE, 12, 0.0, 0.0, 0)
    return folder


def camera() -> Camera:
    """One that looks along z from the origin."""
    return Camera(torch.eye(4).double().numpy(), SIDE, SIDE, SIDE / 2, SIDE / 2, SIDE, SIDE)


def model_of(*places: tuple[float, float, float]) -> Model:
    """Small, nearly opaque splats."""
    count = len(places)
    return Model(
        Splats(
            means=torch.tensor(places),
            log_scales=torch.full((count, 3), 0.1).log(),
            quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
            logit_opacities=torch.full((count,), 4.0),
            sh=torch.zeros(count, 4, 3),
        ),
        {MOTION: Static()},
    )


def left_half() -> torch.Tensor:
    return (torch.arange(SIDE) < SIDE // 2).expand(SIDE, SIDE)


@pytest.mark.parametrize("engine", ["cpu", "reference"])
def test_what_splats_show_adds_up_to_what_the_picture_shows(engine: str) -> None:
    model = model_of((-0.6, 0.1, 2.0), (0.5, 0.0, 2.0), (0.02, -0.4, 1.5), (-0.9, 0.15, 3.0))
    drawing, seen = load_engine(engine), [(camera(), 0.3, left_half())]
    inside, total = shown_inside(model, drawing, seen, BLACK, 0.0)
    alpha = drawing.rasterize(model.at(model.instant(0.3)), camera(), BLACK).alpha.detach()
    assert float(total.sum()) == pytest.approx(float(alpha.sum()), rel=1e-4)
    assert float(inside.sum()) == pytest.approx(float((alpha * left_half()).sum()), rel=1e-4)
    share = inside / total
    assert share[0] == 1 and share[1] == 0 and 0.2 < share[2] < 0.8
    assert total[3] < 0.2 * total[0]  # behind the first


def test_masks_are_grown_by_a_margin() -> None:
    model, mask = model_of((0.35, 0.0, 2.0)), left_half()
    given = model, load_engine("cpu"), [(camera(), 0.0, mask)], BLACK
    assert shown_inside(*given, 0.0)[0][0] == 0
    inside, total = shown_inside(*given, 0.4)
    assert float(inside) == pytest.approx(float(total))


def test_it_trains_with_workers_without_and_resumed(capture: Path, tmp_path: Path) -> None:
    trainer = assert_trains_the_same_in_all_ways(capture, tmp_path, *PARTS)
    assert 0 < trainer.model.moving < len(trainer.model.splats)
    assert trainer.checkpoint().state["events"]["motion_masks"] == {"rounds": 4}
    assert not any("mask" in note for note in trainer.notes)


def test_what_stands_still_shows_less_of_what_moves(capture: Path) -> None:
    trainer = trainer_of(capture, preset_of(*PARTS, "density.start=999"))
    for _ in range(40):
        trainer.step()
    population, model = trainer.population, trainer.model
    seen = population.marked(100)
    assert len(seen) == len(trainer.views)
    inside, total = shown_inside(model, population.engine, seen, population.background, 0.0)
    moves = torch.arange(len(total)) < model.moving
    shares = [float(inside[which].sum() / total[which].sum()) for which in (~moves, moves)]
    assert shares[0] < 0.5 * shares[1]


def test_what_has_stood_still_moves_again_where_masks_say_so(capture: Path) -> None:
    trainer = trainer_of(capture, preset_of(*PARTS))
    for _ in range(8):
        trainer.step()
    before = trainer.model.moving
    everything = torch.ones(SIDE * 3 // 4, SIDE, dtype=torch.bool)
    trainer.population.marked = lambda most: [
        (trainer.renderer.pictures.camera(view), view.time, everything) for view in trainer.views
    ]
    event = trainer.events["motion_masks"]
    change = event.apply(trainer.population, Tick(9, 0.2))
    assert change is not None
    trainer.population.resize(change)
    assert 0 < before < len(trainer.model.splats) and trainer.model.moving > before
    trainer.step()


def test_without_masks_everything_may_move_and_that_is_said(capture: Path, tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    shutil.copytree(capture, bare)
    layout = bare / "transforms.json"
    document = json.loads(layout.read_text())
    for frame in document["frames"]:
        del frame["motion_mask_path"]
    layout.write_text(json.dumps(document))
    trainer = trainer_of(bare, preset_of(*PARTS))
    assert any("no train view has a mask of what moves" in note for note in trainer.notes)
    for _ in range(10):
        trainer.step()
    assert trainer.model.moving == len(trainer.model.splats)


@pytest.mark.parametrize(
    ("option", "found"),
    [
        ("rounds: 0", "1 or more"),
        ("views: 0", "1 or more"),
        ("margin: 0.6", "0 to 0.5"),
        ("still_below: 1.1", "0 to 1"),
        ("moving_above: 0.01", "from still_below to 1"),
        ("until: 2", "until"),
    ],
)
def test_options_out_of_range_are_told(option: str, found: str) -> None:
    with pytest.raises(UsageError, match=found):
        start_events(preset_of(f"events=[{{name: motion_masks, {option}}}]"))


def test_rounds_are_spread_evenly() -> None:
    given = "events=[{name: motion_masks, rounds: 4, until: 0.9}]", "training.static_until=0.1"
    event = start_events(preset_of(*given))["motion_masks"]
    assert isinstance(event, MotionMasks)
    asked = []
    for step in range(1, 101):
        if event.due(Tick(step, (step - 0.5) / 100)):
            asked.append(step - 1)
            event.rounds += 1
    assert asked == [10, 30, 50, 70]
