"""Masks that leave out everything are refused before a training learns nothing from them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from datasets import noise, pose, write_json, write_picture

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.training.masks import LOOKED_AT, check_masks


def scene_with_masks(folder: Path, count: int, counts: Callable[[int], bool | None]) -> Path:
    """Write pictures of 16 x 12 px with masks that count all or nothing, or without one."""
    frames = []
    for i in range(count):
        write_picture(folder / f"p{i:03d}.png", noise(12, 16, 3, seed=i))
        matrix = pose(azimuth=0.1 * i)
        frame = {"file_path": f"p{i:03d}.png", "transform_matrix": matrix, "time": i / (count - 1)}
        if counts(i) is not None:
            mask = np.full((12, 16, 1), 255 * bool(counts(i)), np.uint8)
            write_picture(folder / f"m{i:03d}.png", mask)
            frame["mask_path"] = f"m{i:03d}.png"
        frames.append(frame)
    lens = {"fl_x": 20.0, "fl_y": 20.0, "cx": 8.0, "cy": 6.0, "w": 16, "h": 12}
    names = [frame["file_path"] for frame in frames]
    write_json(
        folder / "transforms.json",
        {**lens, "frames": frames, "train_filenames": names, "val_filenames": []},
    )
    return folder


def checked(folder: Path) -> str | None:
    views = read_scene(folder).split("train")
    return check_masks(Pictures((1.0, 1.0, 1.0), 1, 1 << 20), views)


def test_masks_that_count_something_are_fine(tmp_path: Path) -> None:
    assert checked(scene_with_masks(tmp_path / "a", 5, lambda i: True)) is None
    assert checked(scene_with_masks(tmp_path / "b", 5, lambda i: None)) is None


def test_masks_that_count_nothing_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="every pixel of 5 of 5 train views looked at") as caught:
        checked(scene_with_masks(tmp_path / "a", 5, lambda i: False))
    assert "m000.png; white counts, black does not: invert them" in str(caught.value)


@pytest.mark.parametrize("other", [None, True])
def test_some_that_count_nothing_are_told(tmp_path: Path, other: bool | None) -> None:
    told = checked(scene_with_masks(tmp_path, 6, lambda i: False if i in (2, 4) else other))
    assert told is not None and told.startswith("masks leave out every pixel of 2 of 6 train")
    assert told.endswith("m002.png; white counts, black does not: nothing is learnt from these")


def test_few_of_many_masks_are_read(tmp_path: Path) -> None:
    folder = scene_with_masks(tmp_path, 3 * LOOKED_AT, lambda i: False)
    with pytest.raises(DataError, match=f"of {LOOKED_AT} of {LOOKED_AT} train views looked at"):
        checked(folder)
