"""Lenses of COLMAP's cameras, against its own projection."""

from __future__ import annotations

import numpy as np
import pytest

from gsdmsr_cli.capture.reconstruction import lens_of
from gsdmsr_cli.scene import imaging  # noqa: F401  (before pycolmap, see there)

CAMERAS = {
    "SIMPLE_PINHOLE": [50.0, 19.0, 33.0],
    "PINHOLE": [50.0, 52.0, 19.0, 33.0],
    "SIMPLE_RADIAL": [50.0, 19.0, 33.0, 0.1],
    "RADIAL": [50.0, 19.0, 33.0, 0.1, -0.02],
    "OPENCV": [50.0, 52.0, 19.0, 33.0, 0.1, -0.02, 0.03, 0.04],
    "OPENCV_FISHEYE": [50.0, 52.0, 19.0, 33.0, 0.1, -0.02, 0.003, 0.004],
}


@pytest.mark.parametrize("model", CAMERAS)
def test_a_lens_projects_as_colmap_does(model: str) -> None:
    import pycolmap

    params = np.array(CAMERAS[model])
    camera = pycolmap.Camera(model=model, width=40, height=64, params=params)
    lens = lens_of(model, params, 40, 64)
    places = np.random.default_rng(0).uniform(-0.5, 0.5, (30, 2))
    expected = camera.img_from_cam(np.c_[places, np.ones(30)])
    found = np.stack(lens.project(places[:, 0], places[:, 1]), axis=1)
    np.testing.assert_allclose(found, expected, atol=1e-9)
    assert (lens.width, lens.height) == (40, 64)
