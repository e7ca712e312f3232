"""Points on surfaces, against a textured wall whose pictures are known in closed form."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from datasets import write_picture
from kernel_checks import generator
from torch import Tensor

from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.options.preset import SplatOptions
from gsdmsr_cli.scene.camera import Camera, look_at
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene, View
from gsdmsr_cli.training.starting import surfaces
from gsdmsr_cli.training.starting.initial import initial_splats
from gsdmsr_cli.training.starting.sightings import colours_of, places
from gsdmsr_cli.training.starting.surfaces import _Album, sample_points

WALL = 1.0
"""The wall is the plane y = 1; cameras look at it from about y = -3."""


def texture(x: np.ndarray, z: np.ndarray) -> np.ndarray:
    waves = [np.sin(5 * x + 3 * z), np.cos(7 * z - 2 * x), np.sin(4 * x) * np.cos(6 * z)]
    return 0.5 + 0.4 * np.stack(waves, axis=-1)


def photograph(camera: Camera) -> Tensor:
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    x, y = (columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy
    rays = np.stack([x, y, np.ones_like(x)], -1) @ camera.rotation
    at = camera.centre + rays * ((WALL - camera.centre[1]) / rays[..., 1])[..., None]
    picture = (255 * texture(at[..., 0], at[..., 2])).round().astype(np.uint8)
    return torch.from_numpy(picture).permute(2, 0, 1).contiguous()


class Album(Pictures):
    def __init__(self, pictures: list[Tensor]) -> None:
        super().__init__((1.0, 1.0, 1.0), 1, 0)
        self.pictures = pictures

    def load(self, view: View) -> Tensor:
        return self.pictures[int(view.name)]


def capture(count: int, moments: int = 1) -> tuple[Scene, Album]:
    """Cameras along a line; each takes the wall at so many moments, or one after the other."""
    shots = []
    for i in range(count):
        centre = np.array([-1 + 2 * i / max(count - 1, 1), -3.0, 0.4 * np.sin(2.5 * i)])
        pose = look_at(centre, np.array([0.0, WALL, 0]), np.array([0.0, 0.0, 1.0]))
        shots.append(Camera(pose, 90.0, 90.0, 48.0, 40.0, 96, 80))
    times = [i / max(count - 1, 1) for i in range(count)]
    if moments > 1:
        times = [t / moments for _ in shots for t in range(moments)]
        shots = [shot for shot in shots for _ in range(moments)]
    views = tuple(
        View(str(i), shot, time, "train", Path())
        for i, (shot, time) in enumerate(zip(shots, times, strict=True))
    )
    nothing = np.zeros((0, 3), np.float32)
    scene = Scene(Path(), "test", views, nothing, None, None, 3.0, "")
    return scene, Album([photograph(shot) for shot in shots])


@pytest.mark.parametrize("moments", [1, 30])
def test_points_lie_on_the_wall_in_its_colours(moments: int) -> None:
    """For one camera that moves, and for a rig of cameras that do not."""
    scene, pictures = capture(12, moments)
    points = sample_points(scene, pictures, 600, generator(0))
    assert points.means.shape == points.colours.shape == (600, 3)
    off = (points.means[:, 1] - WALL).abs()
    # depths about the best of the first ones are, 4 away, 4^2 (1 / 0.5 - 1 / 6.1) / 40 * 2 / 11 =
    # 0.13 apart, so half of that is the most that is lost by trying only some
    assert off.median() < 0.07 and (off < 0.25).float().mean() > 0.85
    on_wall = off < 0.1
    expected = texture(points.means[on_wall, 0].numpy(), points.means[on_wall, 2].numpy())
    assert on_wall.sum() > 200
    assert np.abs(points.colours[on_wall].numpy() - expected).mean() < 0.04


def test_a_single_view_has_rays_but_no_depths() -> None:
    scene, pictures = capture(1)
    points = sample_points(scene, pictures, 200, generator(0))
    column, row, shown = places(points.means, scene.views[0].camera)
    assert shown.all() and points.means.isfinite().all()
    pixels = pictures.load(scene.views[0])[:, row.long(), column.long()].T / 255
    assert (points.colours - pixels).abs().mean() < 0.05
    assert points.means.norm(dim=1).std() > 0.1


def test_pixels_that_do_not_count_send_no_rays(tmp_path: Path) -> None:
    scene, pictures = capture(12)
    mask = np.zeros((80, 96, 1), np.uint8)
    mask[:, :48] = 255
    write_picture(tmp_path / "mask.png", mask)
    views = tuple(replace(view, signals={"mask": tmp_path / "mask.png"}) for view in scene.views)
    points = sample_points(replace(scene, views=views), pictures, 300, generator(0))
    # the left half of each camera's picture is x < 0 on the wall, but for turns of its head
    assert (points.means[:, 0] < 0.4).float().mean() > 0.95


def test_points_are_of_the_time_of_the_view_that_sent_their_rays() -> None:
    """A view that looks at half of the wall sends no rays to the other one."""
    scene, _ = capture(2)
    left, right = (replace(v.camera, cx=cx) for v, cx in zip(scene.views, (148, -52), strict=True))
    views = tuple(replace(v, camera=c) for v, c in zip(scene.views, (left, right), strict=True))
    album = Album([photograph(left), photograph(right)])
    points = sample_points(replace(scene, views=views), album, 100, generator(0))
    assert set(points.times.tolist()) == {0.0, 1.0}
    for time, camera in enumerate((left, right)):
        assert places(points.means[points.times == time], camera)[2].all()
        assert not places(points.means[points.times != time], camera)[2].all()


def test_surfaces_join_points_that_are_too_few() -> None:
    """Of which alone it is known when they were seen."""
    scene, pictures = capture(5)
    few = np.array([[0, WALL, 0], [0.1, WALL, 0]], np.float32)
    scene = replace(scene, points=few, colours=np.full((2, 3), 0.25, np.float32))
    for count, total in ((40, 40), (2, 2), (1, 2)):
        options = SplatOptions(start="surfaces", count=count)
        splats, times = initial_splats(scene, options, pictures, torch.ones(3), generator(0), 100)
        assert len(splats) == total
        assert times.isfinite().tolist() == [False] * 2 + [True] * (total - 2)
        assert torch.equal(splats.means[:2], torch.from_numpy(few))
        assert (SH_C0 * splats.sh[:2, 0] + 0.5).numpy() == pytest.approx(0.25)
    options = SplatOptions(start="box", count=40)
    splats, _ = initial_splats(scene, options, pictures, torch.ones(3), generator(0), 100)
    assert len(splats) == 2


def test_the_seed_decides() -> None:
    scene, pictures = capture(5)
    one, same, other = (sample_points(scene, pictures, 50, generator(s)).means for s in (1, 1, 2))
    assert torch.equal(one, same) and not torch.equal(one, other)


def test_colours_are_the_mean_of_what_views_show() -> None:
    scene, pictures = capture(6)
    x, z = np.meshgrid(np.linspace(-0.5, 0.5, 7), np.linspace(-0.5, 0.5, 7))
    wall = np.stack([x.ravel(), np.full(x.size, WALL), z.ravel()], axis=1).astype(np.float32)
    hidden = np.array([[0, -9.0, 0]], np.float32)  # behind all cameras
    found = colours_of(torch.from_numpy(np.concatenate([wall, hidden])), scene, pictures)
    # a pixel is 4 / 90 of a unit wide, over which the texture changes by at most 0.4 * 8 * 0.022
    assert np.abs(found[:-1].numpy() - texture(wall[:, 0], wall[:, 2])).max() < 0.08
    assert found[-1].tolist() == [0.5] * 3


@pytest.mark.parametrize("shift", [0.0, 0.49, -0.49])
def test_places_are_pixels(shift: float) -> None:
    camera = Camera(np.eye(4), 10.0, 20.0, 4.0, 3.0, 8, 6)
    points = torch.tensor([[0.1, 0.05, 1.0], [0.2 + shift, 0, 2.0], [0, 0, -1.0], [-1.0, 0, 1.0]])
    column, row, shown = places(points, camera)
    assert column[:2].tolist() == pytest.approx([5, 4 + 10 * (0.2 + shift) / 2])
    assert row[0].item() == pytest.approx(4) and shown.tolist() == [True, True, False, False]


def album_of(cameras: list[Camera], times: list[float], mask: Tensor | None = None) -> _Album:
    """Views of pictures that are not larger than what is worked on."""
    views = [
        View(str(i), camera, time, "train", Path())
        for i, (camera, time) in enumerate(zip(cameras, times, strict=True))
    ]
    pictures = Album([torch.zeros(3, camera.height, camera.width) for camera in cameras])
    pictures.signal = lambda view, name: mask  # type: ignore[method-assign]
    nothing = np.zeros((0, 3), np.float32)
    scene = Scene(Path(), "test", tuple(views), nothing, None, None, 1.0, "")
    return _Album(scene, pictures)


def test_how_many_small_pictures_are_kept_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    scene, pictures = capture(12)
    most = list[int]()
    whole = _Album.picture

    def watched(album: _Album, row: int) -> Tensor:
        found = whole(album, row)
        most.append(len(album._loaded))
        return found

    monkeypatch.setattr(_Album, "picture", watched)
    found = []
    for kept in (1, 4, 1000):
        monkeypatch.setattr(surfaces, "KEPT", kept)
        most.clear()
        found.append(sample_points(scene, pictures, 600, generator(0)))
        assert max(most) == min(kept, 12)
    for one in found[:2]:
        assert all(map(torch.equal, one, found[2]))


def test_partners_are_near_but_not_at_one_place_with_each_other() -> None:
    """Cameras on a line at 0, 0.1, 1, 1.1, 2 and so on: of each pair one is enough."""
    places = [i + 0.1 * second for i in range(5) for second in (0, 1)]
    cameras = []
    for x in places:
        pose = np.eye(4)
        pose[0, 3] = -x
        cameras.append(Camera(pose, 50.0, 50.0, 15.0, 10.0, 30, 20))
    album = album_of(cameras, [0.0] * 10)
    assert album.partners(0) == [2, 4, 6, 8]
    assert album.partners(9) == [7, 5, 3, 1]
    # a moment is worth as much as the spread of the cameras, which is 2.05
    album = album_of(cameras, [0.0, 0.0, 1.0, *[0.0] * 7])
    assert album.partners(0) == [3, 4, 6, 8]


@pytest.mark.parametrize("tall", [False, True])
def test_pixels_count_by_the_mask_whose_size_is_its_own(tall: bool) -> None:
    """Of 60 x 40 px, over a picture of 30 x 20, or both turned."""
    mask = torch.zeros(40, 60, dtype=torch.bool)
    mask[30:, 45:] = True
    width, height = (20, 30) if tall else (30, 20)
    camera = Camera(np.eye(4), 50.0, 50.0, width / 2, height / 2, width, height)
    album = album_of([camera], [0.0], mask.T if tall else mask)
    pixels = torch.tensor([[22.4, 15.1], [22.6, 15.1], [22.6, 14.9], [29.9, 19.9], [0.0, 0.0]])
    found = album.counted(0, pixels.flip(1) if tall else pixels)
    assert found.tolist() == [False, True, False, True, False]
