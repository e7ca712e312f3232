"""Flow between two pictures: how far a texture has gone, and which pixels are to be believed."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from gsdmsr_cli.scene.optical_flow import ends_of, optical_flow, trusted

HEIGHT, WIDTH = 64, 96


def texture(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(HEIGHT + 8, WIDTH + 8))
    return np.clip(128 + 250 * cv2.GaussianBlur(noise, (0, 0), 2), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(("x", "y"), [(3, 0), (-2, 4), (0, 0)])
def test_a_texture_that_is_shifted_has_the_flow_of_the_shift(x: int, y: int) -> None:
    here = texture()[4 : 4 + HEIGHT, 4 : 4 + WIDTH]
    there = texture()[4 - y : 4 - y + HEIGHT, 4 - x : 4 - x + WIDTH]
    forward, back = optical_flow(here, there), optical_flow(there, here)
    sure = trusted(forward, back, 1.0)
    assert forward.dtype == np.float32 and sure[8:-8, 8:-8].mean() > 0.95
    np.testing.assert_allclose(forward[sure].mean(axis=0), [x, y], atol=0.1)
    if x > 0:
        assert not sure[:, -1].any(), "what leaves the picture cannot be followed"
    columns, rows = ends_of(forward)
    np.testing.assert_allclose(
        columns - forward[..., 0], np.arange(WIDTH)[None, :] + 0 * rows, atol=1e-4
    )
    np.testing.assert_allclose((rows - forward[..., 1])[:, 5], np.arange(HEIGHT), atol=1e-4)


def test_flow_between_what_has_nothing_in_common_is_not_trusted() -> None:
    here, there = (texture(seed)[:HEIGHT, :WIDTH] for seed in (0, 1))
    assert trusted(optical_flow(here, there), optical_flow(there, here), 0.5).mean() < 0.5
