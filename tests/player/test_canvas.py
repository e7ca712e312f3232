"""What the page draws, in a real browser, against the project's own renderer."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import files_by_hand as by_hand
import numpy as np
import pytest
import torch
from chromium import Chromium
from files_by_hand import File
from numpy.typing import NDArray

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.player.page import page
from gsdmsr_cli.raster import reference
from gsdmsr_cli.scene.camera import Camera, look_at

UP = np.array([0.0, 0.0, 1.0])
CAMERAS = (
    Camera(look_at(np.array([2.0, -2.4, 1.2]), np.zeros(3), UP), 110.0, 110.0, 60.0, 48.0, 120, 96),
    Camera(look_at(np.array([-1.4, 0.5, -0.6]), np.zeros(3), UP), 84.0, 97.0, 41.3, 70.2, 90, 130),
)
WHITE, BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)

READ = """(async () => {
  const pixels = await dsplat.pixels();
  let text = "";
  for (let i = 0; i < pixels.length; i += 4096) {
    text += String.fromCharCode(...pixels.subarray(i, i + 4096));
  }
  return btoa(text);
})()"""


def show(browser: Chromium, file: File | bytes, folder: Path) -> None:
    """Open the page of a file, paused, and wait for its first picture."""
    data = file if isinstance(file, bytes) else file.encode()
    path = folder / "scene.html"
    path.write_text(page(data, None, "a scene"), encoding="utf-8")
    browser.open(path, 600, fragment="#paused")
    browser.evaluate("dsplat.ready")


def drawn_by_page(
    browser: Chromium, camera: Camera, time: float, background: tuple[float, ...]
) -> NDArray[np.uint8]:
    """Return what the canvas shows, (H, W, 3)."""
    pose: Any = camera.world_to_camera.reshape(-1).tolist()
    names = ("fx", "fy", "cx", "cy", "width", "height")
    view = {"world_to_camera": pose} | {name: getattr(camera, name) for name in names}
    browser.evaluate(
        f"dsplat.setCamera({json.dumps(view)}), dsplat.setTime({time}), "
        f"dsplat.background({list(background)})"
    )
    pixels = np.frombuffer(base64.b64decode(browser.evaluate(READ)), np.uint8)
    return pixels.reshape(camera.height, camera.width, 4)[..., :3]


def drawn_by_reference(
    file: File, camera: Camera, time: float, *backgrounds: tuple[float, ...]
) -> list[NDArray[np.uint8]]:
    """Return what should be there over each background."""
    with torch.no_grad():
        splats = Moment(file.at(time))
        frame = reference.rasterize(splats, camera, torch.zeros(3, dtype=torch.float64))
    over = [frame.rgb + (1 - frame.alpha)[..., None] * torch.tensor(b) for b in backgrounds]
    return [(picture.clamp(0, 1) * 255).round().byte().numpy() for picture in over]


def psnr(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    error = ((a.astype(float) - b.astype(float)) ** 2).mean()
    return float(10 * np.log10(255**2 / max(error, 1e-9)))


FILES = {
    **{f"still, degree {degree}": lambda d=degree: by_hand.still(150, d) for degree in range(4)},
    "one splat": lambda: by_hand.still(1),
    "no splat": lambda: by_hand.still(0),
    "bodies, 8 neighbours": lambda: by_hand.with_bodies(24, 8),
    "bodies, each splat follows one": lambda: by_hand.with_bodies(6, 0, degree=3),
    "one body": lambda: by_hand.with_bodies(1, 1),
    "own curves": by_hand.with_own_curves,
    "lives": by_hand.with_lives,
    "everything": by_hand.with_everything,
}


@pytest.mark.parametrize("name", FILES)
def test_the_canvas_shows_what_render_draws(browser: Chromium, tmp_path: Path, name: str) -> None:
    file = FILES[name]()
    show(browser, file, tmp_path)
    scores, shown = [], []
    for time in (0.0, 0.37, 1.0) if file.moving else (0.5,):
        for camera in CAMERAS:
            expected = drawn_by_reference(file, camera, time, WHITE, BLACK)
            found = [drawn_by_page(browser, camera, time, colour) for colour in (WHITE, BLACK)]
            scores += map(psnr, found, expected)
        shown.append(found[0])
    assert min(scores) >= 52, scores
    if len(file.tables["means"]):
        assert np.ptp(shown[0]) > 50
    if file.moving:
        assert max(psnr(*shown[:2]), psnr(*shown[1:])) < 30  # it does move
