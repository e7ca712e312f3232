"""Features are where the spots of a picture are, in its own pixels."""

from __future__ import annotations

import numpy as np
import pytest

from gsdmsr_cli.capture.features import LONGEST, find_features


@pytest.mark.parametrize("shape", [(200, 320), (300, 2 * LONGEST)], ids=["as it is", "shrunk"])
def test_spots_are_found_where_they_are(shape: tuple[int, int]) -> None:
    """Also in pictures that are shrunk for it; pixels count from the corner of the first one."""
    height, width = shape
    size = 6.0 * max(1.0, width / LONGEST)
    spots = [
        (0.2 * width, 0.3 * height),
        (0.71 * width, 0.6 * height),
        (0.5 * width, 0.45 * height),
    ]
    rows, columns = np.mgrid[:height, :width] + 0.5
    grey = np.full(shape, 40.0)
    for x, y in spots:
        grey += 180 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * size**2))
    found = find_features(grey.clip(0, 255).astype(np.uint8), 100)
    assert found.descriptors.shape == (len(found.pixels), 128)
    for spot in spots:
        assert np.linalg.norm(found.pixels - spot, axis=1).min() < 0.1 * size


def test_a_plain_picture_has_no_features() -> None:
    found = find_features(np.full((60, 90), 128, np.uint8), 100)
    assert found.pixels.shape == (0, 2) and found.descriptors.shape == (0, 128)
