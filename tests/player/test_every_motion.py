"""A file of every motion there is, on the page and drawn by the package."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from chromium import Chromium
from files_by_hand import SCENE
from motion_checks import FACTS, disturbed, splats_of, started
from test_canvas import BLACK, WHITE, drawn_by_page, psnr, show

from gsdmsr_cli.ground import plugins
from gsdmsr_cli.model import motion as motions
from gsdmsr_cli.model.model import MOTION, Model
from gsdmsr_cli.moving.baking import bake
from gsdmsr_cli.moving.coding import coded, described, steps_named
from gsdmsr_cli.moving.container import from_bytes, to_bytes
from gsdmsr_cli.moving.decoding import decoded
from gsdmsr_cli.moving.parts import packed
from gsdmsr_cli.moving.playing import model_of
from gsdmsr_cli.raster import reference
from gsdmsr_cli.scene.camera import Camera, look_at

SPLATS = 90
UP = np.array([0.0, 0.0, 1.0])
CAMERAS = (
    Camera(look_at(np.array([2.6, -3.2, 1.2]), np.zeros(3), UP), 100.0, 100.0, 48.0, 48.0, 96, 96),
    Camera(look_at(np.array([-2.4, 1.5, -1.6]), np.zeros(3), UP), 80.0, 80.0, 40.0, 50.0, 80, 100),
)


@pytest.fixture(params=plugins.names(motions.__name__))
def data(request: pytest.FixtureRequest) -> bytes:
    """The file of splats with a motion that moves them."""
    motion = disturbed(started(request.param, SPLATS))
    with torch.no_grad():
        baked = bake(Model(splats_of(SPLATS), {MOTION: motion}), 12)
        parts = [packed(table) for table in coded(baked, steps_named(baked), FACTS.bound)]
    return to_bytes({**described(baked), "scene": SCENE, "about": {}}, parts)


def test_the_canvas_shows_what_the_package_draws_of_the_file(
    browser: Chromium, tmp_path: Path, data: bytes
) -> None:
    show(browser, data, tmp_path)
    model = model_of(decoded(*from_bytes(data)))
    scores = []
    for time in (0.0, 0.37, 1.0):
        with torch.no_grad():
            moment = model.at(model.instant(time))
        for camera in CAMERAS:
            with torch.no_grad():
                frame = reference.rasterize(moment, camera, torch.zeros(3))
            for colour in (WHITE, BLACK):
                over = frame.rgb + (1 - frame.alpha)[..., None] * torch.tensor(colour)
                expected = (over.clamp(0, 1) * 255).round().byte().numpy()
                found = drawn_by_page(browser, camera, time, colour)
                scores.append(psnr(found, expected))
    assert min(scores) >= 45, scores
