"""What has changed since the moment before: tiles that have are seen, the others now and then."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from kernel_checks import generator
from rigs import write_rig
from stream_checks import MOMENTS, each_moment, stream_trainer, through
from torch import Tensor
from training_checks import assert_same_tensors

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground.splatting_constants import TILE
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import View
from gsdmsr_cli.training.gradients.phase import Order
from gsdmsr_cli.training.streaming.changes import LEAST_SHARE, UNCHANGED, Changes, changed_tiles
from gsdmsr_cli.training.streaming.trainer import StreamTrainer


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_rig(tmp_path_factory.mktemp("rig"), size=96, moments=MOMENTS, span=0.02)


def picture(height: int, width: int, grey: int = 100) -> Tensor:
    return torch.full((3, height, width), grey, dtype=torch.uint8)


def test_a_tile_that_differs_counts_with_those_beside_it() -> None:
    before = picture(5 * TILE, 6 * TILE)
    now = before.clone()
    now[:, 2 * TILE + 5 : 2 * TILE + 9, 3 * TILE + 8 : 3 * TILE + 12] += 40
    expected = torch.zeros(5, 6, dtype=torch.bool)
    expected[1:4, 2:5] = True
    assert torch.equal(changed_tiles(before, now, 0.04).view(5, 6), expected)


def test_a_corner_has_fewer_neighbours_and_a_picture_no_whole_number_of_tiles() -> None:
    before = picture(2 * TILE + 3, 3 * TILE + 1)
    now = before.clone()
    now[:, -1, -1] += 40
    expected = torch.zeros(3, 4, dtype=torch.bool)
    expected[1:, 2:] = True
    assert torch.equal(changed_tiles(before, now, 0.04).view(3, 4), expected)


def test_noise_of_single_pixels_is_no_change() -> None:
    before = picture(64, 64)
    noisy = before + torch.randint(-9, 10, (3, 64, 64), generator=generator()).byte()
    assert not changed_tiles(before, noisy, 0.04).any()
    assert changed_tiles(before, before + 11, 0.04).all()


def changes_of(rig: Path, least: float = 0.04) -> tuple[Changes, list[View], Pictures]:
    views = read_scene(rig).split("train")
    pictures = Pictures((1.0, 1.0, 1.0), 1, 1 << 24)
    return Changes(least, views, pictures), views, pictures


def rows_at(views: list[View], moment: int) -> list[int]:
    times = sorted({view.time for view in views})
    return [row for row, view in enumerate(views) if view.time == times[moment]]


def test_a_view_is_compared_with_that_of_its_camera_at_the_moment_before(rig: Path) -> None:
    changes, views, pictures = changes_of(rig)
    now, before = rows_at(views, 2), rows_at(views, 1)
    changes.begin(now, before[::-1])  # in whatever order
    for row, earlier in zip(now, before, strict=True):
        expected = changed_tiles(pictures.load(views[earlier]), pictures.load(views[row]), 0.04)
        found = changes.tiles(row)
        assert found is not None and torch.equal(found, expected)
        assert 0 < found.sum() < len(found)


def test_where_nobody_knows_all_is_seen(rig: Path) -> None:
    changes, views, pictures = changes_of(rig)
    first = rows_at(views, 0)
    changes.begin(first, ())
    assert changes.weights(first[0], pictures, generator()) is None
    assert changes.wants(first[0], first, generator())


def test_a_camera_that_has_moved_is_another_one(rig: Path) -> None:
    changes, views, pictures = changes_of(rig)
    now, before = rows_at(views, 1), rows_at(views, 0)
    pose = views[now[0]].camera.world_to_camera.copy()
    pose[0, 3] += 0.01
    moved = replace(views[now[0]], camera=replace(views[now[0]].camera, world_to_camera=pose))
    others = [moved if row == now[0] else view for row, view in enumerate(views)]
    changes = Changes(0.04, others, pictures)
    changes.begin(now, before)
    assert changes.tiles(now[0]) is None and changes.tiles(now[1]) is not None


def test_what_has_not_changed_is_seen_now_and_then(rig: Path) -> None:
    changes, views, pictures = changes_of(rig)
    now = rows_at(views, 1)
    changes.begin(now, rows_at(views, 0))
    tiles, source = changes.tiles(now[0]), generator()
    seen = torch.stack([changes.weights(now[0], pictures, source) for _ in range(2000)])
    assert tiles is not None and set(seen.unique().tolist()) == {0.0, 1.0}
    assert (seen[:, tiles] == 1).all()
    torch.testing.assert_close(
        seen[:, ~tiles].mean(dim=0),
        torch.full((int((~tiles).sum()),), UNCHANGED),
        atol=0.03,
        rtol=0,
    )


def test_cameras_that_see_less_change_are_looked_through_less_often(
    rig: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    changes, views, _ = changes_of(rig)
    now, source = rows_at(views, 1), generator()
    changes.begin(now, rows_at(views, 0))
    shares = {row: share for row, share in zip(now, (0.4, 0.2, 0.1, 0.04, 0, 0.3), strict=True)}
    monkeypatch.setattr(changes, "_share", shares.__getitem__)
    for row, share in shares.items():
        often = sum(changes.wants(row, now, source) for _ in range(2000)) / 2000
        assert often == pytest.approx(max(share / 0.4, LEAST_SHARE), abs=0.04)
    monkeypatch.setattr(changes, "_share", lambda row: 0.0)
    assert all(changes.wants(row, now, source) for row in now)


def test_tiles_are_those_of_the_pictures_that_are_drawn(
    rig: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of half the size at first; all of them at the first moment."""
    seen: list[tuple[int, float, int | None]] = []
    order = StreamTrainer._order

    def remember(self: StreamTrainer, row: int, progress: float) -> Order:
        made = order(self, row, progress)
        tiles = None if made.tile_weights is None else len(made.tile_weights)
        seen.append((self.clock.moment, progress, tiles))
        return made

    monkeypatch.setattr(StreamTrainer, "_order", remember)
    options = "stream.changed=0.04", "training.low_resolution_until=0.4", "stream.steps=16"
    through(stream_trainer(rig, *options), 2)
    assert {tiles for moment, _, tiles in seen if not moment} == {None}
    later = {(progress < 0.4, tiles) for moment, progress, tiles in seen if moment}
    assert later == {(True, 9), (False, 36)}


def test_tiles_are_those_of_the_step_where_time_goes_on_meanwhile(rig: Path) -> None:
    """With a budget the clock is beyond the progress that the step has begun with."""
    trainer = stream_trainer(rig, "stream.changed=0.04", "training.low_resolution_until=0.4")
    through(trainer, 1)
    trainer.begin_next()
    for progress, tiles in ((0.39, 9), (0.4, 36)):
        weights = trainer._order(trainer.shot.rows[0], progress).tile_weights
        assert weights is not None and len(weights) == tiles


def test_a_stream_that_looks_at_changes_goes_on_as_if_it_had_not_ended(rig: Path) -> None:
    whole, first = (stream_trainer(rig, "stream.changed=0.04") for _ in range(2))
    through(whole, 3)
    for moment in each_moment(first):
        if moment == 1:
            break
    first.begin_next()
    for _ in range(3):
        first.step()
    second = stream_trainer(rig, "stream.changed=0.04")
    second.restore(first.checkpoint())
    through(second, 3)
    assert_same_tensors(second.model.tensors(), whole.model.tensors())
