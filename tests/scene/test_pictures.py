"""The cache of targets: right pixels, right cameras, bounded memory, any thread."""

from __future__ import annotations

from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from datasets import noise, write_picture

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene import imaging
from gsdmsr_cli.scene.block_store import BLOCK
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.pictures import HalvedPictures, Pictures
from gsdmsr_cli.scene.scene import View

WHITE = (1.0, 1.0, 1.0)
SIDE = 8
ROOM = BLOCK + 64
"""Memory for one small picture, with its row of the table."""


def make_view(path: Path, width: int = SIDE, height: int = SIDE) -> View:
    camera = Camera(np.eye(4), 20.0, 22.0, width / 2, height / 2, width, height)
    return View(path.stem, camera, 0.0, "train", path)


@pytest.fixture
def views(tmp_path: Path) -> list[View]:
    paths = [tmp_path / f"{i}.png" for i in range(5)]
    for i, path in enumerate(paths):
        write_picture(path, noise(SIDE, SIDE, seed=i))
    return [make_view(path) for path in paths]


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How often each file was read."""
    counts: Counter[str] = Counter()
    read = imaging.read_image

    def counting(path: Path) -> np.ndarray:
        counts[path.stem] += 1
        return read(path)

    monkeypatch.setattr(imaging, "read_image", counting)
    return counts


@pytest.mark.parametrize(("downscale", "width", "height"), [(1, 9, 6), (2, 4, 3), (3, 3, 2)])
def test_picture_is_composited_and_shrunk_in_float(
    tmp_path: Path, downscale: int, width: int, height: int
) -> None:
    rgba = noise(6, 9, seed=3)
    write_picture(tmp_path / "a.png", rgba)
    view = make_view(tmp_path / "a.png", 9, 6)
    background = (0.25, 0.5, 1.0)
    pictures = Pictures(background, downscale, 10**6)
    picture = pictures.load(view)
    assert picture.dtype == torch.uint8 and picture.is_contiguous()
    assert picture.shape == (3, height, width)

    alpha = rgba[..., 3:] / 255
    over = rgba[..., :3] / 255 * alpha + np.array(background) * (1 - alpha)
    expected = shrink(over, height, width) * 255
    found = picture.permute(1, 2, 0).numpy().astype(float)
    assert np.abs(found - expected).max() <= 0.5 + 1e-3

    camera = pictures.camera(view)
    assert (camera.width, camera.height) == (width, height)
    assert camera.fx == pytest.approx(20 * width / 9)
    assert camera.cy == pytest.approx(height / 2)


def shrink(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """Area means as a product of two matrices of overlaps."""

    def overlaps(old: int, new: int) -> np.ndarray:
        edges = np.arange(new + 1) * old / new
        low, high = edges[:-1, None], edges[1:, None]
        cover = np.minimum(high, np.arange(1, old + 1)) - np.maximum(low, np.arange(old))
        return cover.clip(0) * new / old

    rows, columns = overlaps(image.shape[0], height), overlaps(image.shape[1], width)
    return np.einsum("hi,wj,ijc->hwc", rows, columns, image)


def test_a_picture_of_another_size_than_its_camera_is_refused(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png", noise(6, 9))
    with pytest.raises(DataError, match=r"a\.png is 9 x 6 px, but its camera is 6 x 9"):
        Pictures(WHITE, 1, 10**6).load(make_view(tmp_path / "a.png", 6, 9))


def test_a_picture_is_decoded_once(views: list[View], decoded: Counter[str]) -> None:
    pictures = Pictures(WHITE, 1, 10**6)
    first = pictures.load(views[0])
    assert torch.equal(pictures.load(views[0]), first)
    assert decoded == {"0": 1}


def test_the_least_recently_used_goes_first(views: list[View], decoded: Counter[str]) -> None:
    pictures = Pictures(WHITE, 1, 2 * ROOM)
    for i in (0, 1, 0, 2):  # 1 is the oldest when 2 comes.
        pictures.load(views[i])
    pictures.load(views[0])
    assert decoded == {"0": 1, "1": 1, "2": 1}
    pictures.load(views[1])
    assert decoded == {"0": 1, "1": 2, "2": 1}


def test_a_picture_above_the_limit_is_returned_but_not_kept(
    views: list[View], decoded: Counter[str]
) -> None:
    pictures = Pictures(WHITE, 1, BLOCK)
    torch.testing.assert_close(pictures.load(views[0]), pictures.load(views[0]))
    assert decoded == {"0": 2}


def test_preload_stops_at_the_limit_and_tells(views: list[View], decoded: Counter[str]) -> None:
    pictures = Pictures(WHITE, 1, 3 * ROOM)
    told: list[tuple[int, int]] = []
    pictures.preload(views, lambda done, total: told.append((done, total)))
    assert told == [(1, 3), (2, 3), (3, 3)]
    assert decoded == {"0": 1, "1": 1, "2": 1}
    for view in views[:3]:
        pictures.load(view)
    assert decoded.total() == 3


def test_preload_raises_what_a_picture_raises(views: list[View]) -> None:
    views[2].image_path.unlink()
    with pytest.raises(DataError, match=r"2\.png does not exist"):
        Pictures(WHITE, 1, 10**6).preload(views)


def test_many_threads_get_the_same_pictures(views: list[View]) -> None:
    expected = [Pictures(WHITE, 2, 10**6).load(view) for view in views]
    pictures = Pictures(WHITE, 2, 2 * ROOM)
    order = np.random.default_rng(0).integers(0, 5, 200)
    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(lambda i: pictures.load(views[i]), order))
    for i, picture in zip(order, found, strict=True):
        assert torch.equal(picture, expected[i])


def test_downscale_below_one_is_a_mistake() -> None:
    with pytest.raises(ValueError, match="downscale"):
        Pictures(WHITE, 0, 1)


@pytest.mark.parametrize(("width", "height"), [(9, 6), (8, 8), (1, 5), (1, 1)])
def test_halved_pictures_have_the_cameras_of_their_size(
    tmp_path: Path, width: int, height: int
) -> None:
    write_picture(tmp_path / "a.png", np.full((height, width, 3), 77, np.uint8))
    view = make_view(tmp_path / "a.png", width, height)
    halved = HalvedPictures(Pictures(WHITE, 1, 10**6))
    picture, camera = halved.load(view), halved.camera(view)
    assert (camera.width, camera.height) == (max(1, width // 2), max(1, height // 2))
    assert camera.fx == pytest.approx(20 * camera.width / width)
    assert camera.cy == pytest.approx(camera.height / 2)
    assert torch.equal(picture, torch.full((3, camera.height, camera.width), 77).byte())


@pytest.mark.parametrize("downscale", [1, 2])
def test_halved_pictures_are_means_of_two_by_two(tmp_path: Path, downscale: int) -> None:
    write_picture(tmp_path / "a.png", noise(16, 24, seed=4))
    view, pictures = make_view(tmp_path / "a.png", 24, 16), Pictures(WHITE, downscale, 10**6)
    whole = pictures.load(view).double()
    _, h, w = whole.shape
    expected = whole.reshape(3, h // 2, 2, w // 2, 2).mean(dim=(2, 4))
    found = HalvedPictures(pictures).load(view)
    assert found.dtype == torch.uint8 and found.is_contiguous()
    assert (found.double() - expected).abs().max() <= 0.5


def test_halved_pictures_are_made_once_and_take_no_room_for_whole_ones(
    views: list[View], decoded: Counter[str]
) -> None:
    pictures = Pictures(WHITE, 1, 2 * ROOM)
    halved = HalvedPictures(pictures)
    first = halved.load(views[0])
    assert torch.equal(halved.load(views[0]), first)
    assert not torch.equal(halved.load(views[1]), first)
    assert torch.equal(halved.load(views[0]), first)
    assert decoded == {"0": 1, "1": 1}
    pictures.load(views[0])
    assert decoded["0"] == 2  # only its half was kept


def test_halved_pictures_are_made_from_whole_ones_that_are_there(
    views: list[View], decoded: Counter[str]
) -> None:
    pictures = Pictures(WHITE, 1, 2 * ROOM)
    pictures.load(views[0])
    HalvedPictures(pictures).load(views[0])
    assert decoded == {"0": 1}


def test_released_halved_pictures_leave_whole_ones_and_room(
    views: list[View], decoded: Counter[str]
) -> None:
    pictures = Pictures(WHITE, 1, 3 * ROOM)
    halved = HalvedPictures(pictures)
    pictures.load(views[0])
    expected = halved.load(views[0]), halved.load(views[1])
    halved.release()
    halved.release()
    for i in (2, 3):
        pictures.load(views[i])  # into the room of the two halves
    pictures.load(views[0])
    assert decoded == {"0": 1, "1": 1, "2": 1, "3": 1}
    found = halved.load(views[0]), halved.load(views[1])  # a training may go back in progress
    assert all(map(torch.equal, found, expected))


def test_nothing_is_kept_without_memory(views: list[View], decoded: Counter[str]) -> None:
    pictures = Pictures(WHITE, 1, 0)
    halved = HalvedPictures(pictures)
    for _ in range(2):
        pictures.preload(views)
        assert torch.equal(pictures.load(views[0]), Pictures(WHITE, 1, 10**6).decode(views[0]))
        halved.load(views[1])
        halved.release()
    assert decoded == {"0": 4, "1": 2}


def test_masks_are_white_or_not_in_any_format_and_at_any_size(tmp_path: Path) -> None:
    white = np.zeros((6, 8), bool)
    white[:4, 1:6] = True
    grey = np.where(white, 255, 0).astype(np.uint8)[..., None]
    opaque = np.concatenate([grey, grey, grey, np.full_like(grey, 255)], axis=2)
    for name, pixels in (("grey", grey), ("rgb", grey.repeat(3, 2)), ("rgba", opaque)):
        write_picture(tmp_path / f"{name}.png", pixels)
        path = tmp_path / f"{name}.png"
        view = replace(make_view(path, 8, 6), signals={"mask": path, "moving": path})
        pictures = Pictures(WHITE, 1, 1 << 20)
        for found in (pictures.signal(view, "mask"), pictures.signal(view, "moving")):
            assert found is not None and found.dtype == torch.bool
            assert (found.numpy() == white).all()
        # a pixel of half the size is white where at least two of its four are
        half = Pictures(WHITE, 2, 1 << 20).signal(view, "mask")
        shares = white.reshape(3, 2, 4, 2).mean(axis=(1, 3))
        assert half is not None and (half.numpy() == (shares >= 0.5)).all()


def test_a_view_without_masks_has_none(views: list[View]) -> None:
    pictures = Pictures(WHITE, 1, 1 << 20)
    for name in ("mask", "moving"):
        assert pictures.signal(views[0], name) is None
        assert HalvedPictures(pictures).signal(views[0], name) is None


def test_a_signal_that_nobody_asks_for_is_never_opened(
    tmp_path: Path, views: list[View], decoded: Counter[str]
) -> None:
    write_picture(tmp_path / "mask.png", np.full((SIDE, SIDE, 1), 255, np.uint8))
    signals = {"mask": tmp_path / "mask.png", "moving": tmp_path / "gone.png", "depth": tmp_path}
    view = replace(views[0], signals=signals)
    pictures = Pictures(WHITE, 1, 1 << 20)
    pictures.preload([view])
    pictures.load(view)
    HalvedPictures(pictures).load(view)
    assert decoded == {"0": 1}
    found = pictures.signal(view, "mask")
    assert found is not None and found.all()
    assert decoded == {"0": 1, "mask": 1}
    with pytest.raises(DataError, match=r"gone\.png does not exist"):
        pictures.signal(view, "moving")


def test_a_signal_without_a_decoder_is_a_mistake(views: list[View]) -> None:
    with pytest.raises(ValueError, match="nothing decodes the signal 'depth'; known: mask, moving"):
        Pictures(WHITE, 1, 0).signal(views[0], "depth")


def test_a_mask_and_the_picture_of_one_file_are_not_mixed_up(views: list[View]) -> None:
    pictures = Pictures(WHITE, 1, 1 << 20)
    view = replace(views[0], signals={"mask": views[0].image_path})
    assert pictures.load(view).shape == (3, SIDE, SIDE)
    counted = pictures.signal(view, "mask")
    assert counted is not None and counted.shape == (SIDE, SIDE)
    assert pictures.load(view).shape == (3, SIDE, SIDE)


def test_a_mask_of_another_size_is_refused(tmp_path: Path, views: list[View]) -> None:
    write_picture(tmp_path / "mask.png", noise(4, 4, 1))
    view = replace(views[0], signals={"mask": tmp_path / "mask.png"})
    with pytest.raises(DataError, match=r"mask\.png is 4 x 4 px, but its camera is 8 x 8"):
        Pictures(WHITE, 1, 1 << 20).signal(view, "mask")


def test_the_same_pictures_over_another_background(tmp_path: Path) -> None:
    write_picture(tmp_path / "a.png", np.zeros((SIDE, SIDE, 4), np.uint8))
    view = make_view(tmp_path / "a.png")
    white = Pictures(WHITE, 2, 2 * ROOM)
    assert (white.load(view) == 255).all()
    black = white.over((0.0, 0.0, 0.0))
    assert (black.load(view) == 0).all() and black.load(view).shape == white.load(view).shape
