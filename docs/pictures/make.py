"""Makes the pictures of README and docs from the scene of ``gsdmsr demo`` and nothing else.

    PYTHONPATH=.:tests python docs/pictures/make.py [FOLDER]

FOLDER keeps the scene and its run for another time; both are made if they are not there. The run
has a number of steps instead of the demo's minute, so that but for times the pictures do not depend
on the machine.
"""

from __future__ import annotations

import base64
import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
from chromium import Chromium, find_chromium
from numpy.typing import NDArray

from gsdmsr_cli.demo.solids import Disc
from gsdmsr_cli.demo.synthetic import camera_on_dome, draw, solids_at, write_scene
from gsdmsr_cli.filming.encode import write_video
from gsdmsr_cli.scene.imaging import read_image, write_png

Pixels = NDArray[np.uint8]

HERE = Path(__file__).parent
GSDMSR = sys.executable, "-m", "gsdmsr_cli"

STEPS = 6000
MOVING_FRAMES, MOVING_SIZE, MOVING_FPS = 60, 360, 15
PATHS = "orbit", "spiral", "dolly", "still"
PATH_FRAMES, PATH_SIZE, PATH_FPS = 20, 128, 10
CAPTURE_FRAMES, CAPTURE_SIZE = 20, 400
LENS = "--camera-model", "SIMPLE_PINHOLE"
QUALITY = 80
"""Of WebP, 0 to 100."""


def make_run(folder: Path) -> Path:
    """Make the demo's scene and a run of it in a folder, if they are not there; return the run."""
    scene, run = folder / "scene", folder / "demo"
    if not scene.is_dir():
        write_scene(scene)
    if not run.is_dir():
        _run("train", "--preset", "dnerf", "--data", scene, "--out", run, "--steps", STEPS)
    if not (run / "eval" / "play.html").is_file():
        _run("eval", run, "--report", "--play")
    return run


def moving(run: Path, out: Path) -> None:
    """Make the picture that README begins with: an orbit of the run."""
    frames = _film(run, "orbit", MOVING_FRAMES, MOVING_SIZE)
    write_video("webp", out / "moving.webp", frames, MOVING_FPS)


def paths(run: Path, out: Path) -> None:
    """Make the picture of the camera paths: films of four, side by side."""
    films = [_film(run, path, PATH_FRAMES, PATH_SIZE) for path in PATHS]
    beside = [np.concatenate(row, axis=1) for row in zip(*films, strict=True)]
    write_video("webp", out / "paths.webp", beside, PATH_FPS)


def report(browser: Chromium, run: Path, out: Path) -> None:
    """Make the picture of the report of the run, from its charts to its frames."""
    browser.open(run / "eval" / "report.html", 1100)
    browser.evaluate(
        "[...document.querySelectorAll('section')].filter((section) => !/^(Over|Worst)/"
        ".test(section.innerText)).forEach((section) => section.remove())"
    )
    height = browser.evaluate("document.querySelector('main').getBoundingClientRect().bottom")
    _photograph(browser, out / "report.webp", 1100, height, 0.7)


def player(browser: Chromium, run: Path, out: Path) -> None:
    """Make the picture of the page that plays the run."""
    browser.open(run / "eval" / "play.html", 900, fragment="#time=0.3", height=600)
    browser.evaluate("dsplat.ready.then(() => dsplat.draw())")
    _photograph(browser, out / "player.webp", 900, 600)


def view(browser: Chromium, run: Path, out: Path) -> None:
    """Make the picture of the live view of the run."""
    with _served(run) as address:
        browser.call("Page.navigate", url=address)
        _wait_for(browser, "window.dsplat !== undefined")
        browser.evaluate("dsplat.ready.then(() => (dsplat.setTime(0.3), dsplat.draw()))")
        pictures = "[...document.querySelectorAll('#live img')]"
        _wait_for(browser, f"{pictures}.every((image) => image.naturalWidth > 0)")
        _photograph(browser, out / "view.webp", 900, 600)


def prepare(browser: Chromium, work: Path, out: Path) -> None:
    """Make the pictures of masks and of the report, of a capture of the demo's scene."""
    capture, scene = work / "capture", work / "scene"
    write_capture(capture, CAPTURE_FRAMES, CAPTURE_SIZE)
    _run("prepare", capture, "--out", scene, "--auto-mask", *LENS)
    pictures, masks = (sorted((scene / name).glob("*.png")) for name in ("images", "masks"))
    chosen = [i * len(masks) // 4 for i in range(4)]
    rows = [
        np.concatenate([_rgb(read_image(files[i])) for i in chosen], axis=1)
        for files in (pictures, masks)
    ]
    write_video("webp", out / "masks.webp", [np.concatenate(rows)[::2, ::2]], 1)
    browser.open(scene / "report.html", 900)
    height = browser.evaluate("document.documentElement.scrollHeight")
    _photograph(browser, out / "prepare.webp", 900, height, 0.7)


class Ground(Disc):
    """A wide ground whose tiles all differ, so that they can be told apart."""

    def colours(self, points: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the (3, R) colours of surface points."""
        shades = np.random.default_rng(0).uniform(0.3, 1, (256, 256)).astype(np.float32)
        tiles = np.floor(points[:2] / 0.1).astype(int) % 256
        return super().colours(points) * shades[tiles[0], tiles[1]]


def write_capture(folder: Path, frames: int, size: int) -> None:
    """Write what somebody would film who walks some way round the demo's scene.

    Only the ball moves; the ground fills the pictures, so that there is enough that stands still.
    """
    folder.mkdir(parents=True)
    floor, _, *others = solids_at(0.0)
    ground = replace(floor, solid=Ground(30.0))
    for i in range(frames):
        u = i / (frames - 1)
        ball = solids_at(0.05 + 0.4 * u)[1]
        picture = draw([ground, ball, *others], camera_on_dome(0.5 + 1.2 * u, 0.6, size))
        write_png(folder / f"{i:04d}.png", np.ascontiguousarray(picture[..., :3]))


def _film(run: Path, path: str, frames: int, size: int) -> list[Pixels]:
    """Return the pictures of a film of the run."""
    with tempfile.TemporaryDirectory() as folder:
        words = "--path", path, "--frames", frames, "--size", f"{size}x{size}"
        view = ("--view", "train/r_000") if path == "still" else ()
        smooth = "--supersample", 2, "--video", "none", "--out", folder
        _run("render", run, *words, *view, *smooth)
        return [_rgb(read_image(file)) for file in sorted(Path(folder, path).glob("*.png"))]


def _rgb(pixels: Pixels) -> Pixels:
    return pixels[..., :3] if pixels.shape[2] >= 3 else np.repeat(pixels[..., :1], 3, axis=2)


def _run(*words: object) -> None:
    subprocess.run([*GSDMSR, *map(str, words)], check=True)


@contextmanager
def _served(run: Path) -> Iterator[str]:
    """Serve a run, yield the address, and end the server."""
    line = [*GSDMSR, "view", str(run), "--json"]
    with subprocess.Popen(line, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        try:
            yield json.loads(server.stdout.readline())["address"]
        finally:
            server.terminate()


def _wait_for(browser: Chromium, condition: str) -> None:
    """Return when an expression has become true on the page."""
    asked = f"new Promise((done) => {{ const ask = () => ({condition}) ? done() : "
    browser.evaluate(asked + "setTimeout(ask, 50); ask(); })")


def _photograph(
    browser: Chromium, path: Path, width: float, height: float, scale: float = 1.0
) -> None:
    """Write the upper left part of the page as WebP."""
    clip = {"x": 0, "y": 0, "width": width, "height": height, "scale": scale}
    found = browser.call(
        "Page.captureScreenshot", format="webp", quality=QUALITY, clip=clip,
        captureBeyondViewport=True,
    )  # fmt: skip
    path.write_bytes(base64.b64decode(found["data"]))


def main() -> None:
    """Make all pictures."""
    binary = find_chromium()
    if binary is None:
        sys.exit("no Chromium on the path or in GSDMSR_CHROMIUM")
    with tempfile.TemporaryDirectory() as name:
        work = Path(name)
        run = make_run(Path(sys.argv[1]) if len(sys.argv) > 1 else work)
        moving(run, HERE)
        paths(run, HERE)
        with Chromium(binary, work / "profile") as browser:
            report(browser, run, HERE)
            player(browser, run, HERE)
            view(browser, run, HERE)
            prepare(browser, work, HERE)
    for path in sorted(HERE.glob("*.webp")):
        print(f"{path.name}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
