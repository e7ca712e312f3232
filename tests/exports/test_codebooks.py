"""Few numbers stand for many, and few rows for many rows, as near as their number allows."""

from __future__ import annotations

import numpy as np
import pytest

from gsdmsr_cli.exports._codebooks import codebook, palette
from gsdmsr_cli.scene.imaging import encode_lossless_webp
from gsdmsr_cli.scene.native import cv2


@pytest.mark.parametrize("count", [0, 1, 5, 5000])
def test_codes_are_nearer_than_even_ones(count: int) -> None:
    values = np.random.default_rng(count).normal(size=(count, 3)).astype(np.float32)
    codes, places = codebook(values)
    assert len(codes) == 256 and (np.diff(codes) >= 0).all() and places.shape == values.shape
    if not count:
        return
    even = np.linspace(values.min(), values.max(), 256)
    nearest = np.abs(even - values[..., None]).min(axis=-1)
    off = np.abs(codes[places] - values)
    assert off.max() <= 3 * nearest.max() + 1e-6
    if count <= 85:
        assert not off.any()
    if count > 256:
        assert np.square(off).mean() < 0.8 * np.square(nearest).mean()


def test_rows_are_themselves_where_there_is_room_and_near_ones_where_not() -> None:
    rng = np.random.default_rng(1)
    centres = rng.normal(size=(50, 9)).astype(np.float32)
    rows = centres[rng.integers(0, 50, 3000)] + 1e-3 * rng.normal(size=(3000, 9))
    few, places = palette(rows[:40].astype(np.float32), 64)
    assert np.array_equal(few[places], rows[:40].astype(np.float32))
    few, places = palette(rows.astype(np.float32), 256)
    assert len(few) == 256 and np.abs(few[places] - rows).max() < 0.01
    again, _ = palette(rows.astype(np.float32), 256)
    assert np.array_equal(few, again)


@pytest.mark.parametrize("channels", [3, 4])
def test_webp_pictures_keep_every_byte_where_alpha_is_not_zero(channels: int) -> None:
    rng = np.random.default_rng(2)
    for shape in ((1, 1), (4, 4), (37, 64), (300, 200)):
        pixels = rng.integers(0, 256, (*shape, channels), dtype=np.uint8)
        pixels[..., 3:] = pixels[..., 3:].clip(1)
        back = cv2.imdecode(np.frombuffer(encode_lossless_webp(pixels), "u1"), -1)
        assert np.array_equal(back[..., [2, 1, 0, 3][:channels]], pixels)
