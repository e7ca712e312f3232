"""What the page says of files that it cannot show, and of browsers that cannot show them."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import files_by_hand as by_hand
import numpy as np
import pytest
from chromium import Chromium
from files_by_hand import File
from test_canvas import BLACK, CAMERAS, drawn_by_page, drawn_by_reference, psnr

from gsdmsr_cli.player.page import page

WHOLE = by_hand.with_lives().encode()


def replaced(at: int, content: bytes) -> bytes:
    return WHOLE[:at] + content + WHOLE[at + len(content) :]


def changed(**header: Any) -> bytes:
    file = by_hand.with_bodies(3, 2)
    file.header = header
    return file.encode()


def with_table(name: str, table: Any) -> bytes:
    """Return a file in which a table has another size than it should."""
    file = by_hand.with_bodies(3, 0)
    file.tables[name] = table
    return file.encode()


def without(name: str) -> bytes:
    file = by_hand.with_own_curves()
    del file.tables[name]
    return file.encode()


DAMAGED = {
    "nothing": (b"", "not a file of moving splats"),
    "another file": (b"ply\nformat binary_little_endian 1.0\n" * 9, "not a file of moving splats"),
    "newer": (replaced(8, struct.pack("<I", 2)), "version 2 and this page plays version 1"),
    "cut in the header": (WHOLE[:100], "cut off inside its header"),
    "cut in a part": (WHOLE[:-9], f"should have {len(WHOLE)} bytes or more and has"),
    "header is no JSON": (replaced(30, b"\xff"), "its header cannot be read"),
    "a flipped bit": (replaced(len(WHOLE) - 2000, b"\x00" * 40), "cannot be unpacked"),
    "more move than there are": (changed(moving=999), "its numbers of splats are not possible"),
    "degree": (changed(sh_degree=4), "sh_degree is not 0 to 3"),
    "degree of others": (changed(sh_degree=2), "sh_rest has another size"),
    "times": (changed(times=3), "curves/body/offset has another size"),
    "no bodies": (changed(bodies=None), "body/offset is there without bodies"),
    "more neighbours than bodies": (
        changed(bodies={"count": 3, "neighbours": 4}), "bodies is not possible",
    ),
    "no parts": (changed(parts=None), "it has no list of parts"),
    "a part is a number": (changed(parts=[3]), "a part has no name"),
    "a body that is not there": (
        with_table("body", np.full((120, 1), 3, np.int64)), "body names no body",
    ),
    "no means": (changed(parts=[]), "means is missing"),
    "curves alone": (without("shares/splat/turn"), "splat/turn has curves or shares alone"),
    "colours": (without("sh_0"), "sh_0 is missing"),
}  # fmt: skip
THROWN = "Runtime.exceptionThrown"
TOLD = THROWN, "Log.entryAdded", "Runtime.consoleAPICalled"


def sentence(browser: Chromium, text: str, folder: Path, kept_quiet: tuple[str, ...] = TOLD) -> str:
    """Return what a page says that shows no scene, and check that it says so in one place alone."""
    path = folder / "page.html"
    path.write_text(text, encoding="utf-8")
    browser.open(path, 600, fragment="#paused")
    told = browser.evaluate("dsplat.ready.then(() => null, (error) => error.message)")
    assert told and browser.evaluate("document.querySelector('#message').textContent") == told
    shown = "getComputedStyle(document.querySelector('{}')).{}"
    assert browser.evaluate(shown.format("#scene", "visibility")) == "hidden"
    assert browser.evaluate(shown.format("#timeline", "display")) == "none"
    assert not [event for event in browser.events if event.get("method") in kept_quiet]
    return str(told)


@pytest.mark.parametrize("name", DAMAGED)
def test_a_damaged_or_other_file_gives_a_sentence(
    browser: Chromium, tmp_path: Path, name: str
) -> None:
    data, what = DAMAGED[name]
    told = sentence(browser, page(data, None, "a scene"), tmp_path)
    assert what in told and told.endswith(".") and "\n" not in told


def test_a_file_beside_a_page_on_a_disk_gives_a_sentence(browser: Chromium, tmp_path: Path) -> None:
    (tmp_path / "scene.dsplat").write_bytes(WHOLE)
    path = tmp_path / "page.html"
    path.write_text(page(None, "scene.dsplat", "a scene"), encoding="utf-8")
    browser.open(path, 600, fragment="#paused")
    told = browser.evaluate("dsplat.ready.then(() => null, (error) => error.message)")
    assert "scene.dsplat cannot be loaded: a page that is opened from a disk" in told


class Changed:
    """A script that runs before those of all pages, as long as this context lasts."""

    def __init__(self, browser: Chromium, script: str) -> None:
        self.browser, self.script = browser, script

    def __enter__(self) -> None:
        added = self.browser.call("Page.addScriptToEvaluateOnNewDocument", source=self.script)
        self.name = added["identifier"]

    def __exit__(self, *_: object) -> None:
        self.browser.call("Page.removeScriptToEvaluateOnNewDocument", identifier=self.name)


def test_a_browser_without_webgl2_gives_a_sentence(browser: Chromium, tmp_path: Path) -> None:
    with Changed(browser, "HTMLCanvasElement.prototype.getContext = () => null"):
        assert "no WebGL2" in sentence(browser, page(WHOLE, None, "a scene"), tmp_path)


def test_a_browser_without_workers_gives_a_sentence(browser: Chromium, tmp_path: Path) -> None:
    with Changed(browser, "URL.createObjectURL = () => 'data:text/javascript,1'"):
        told = sentence(browser, page(WHOLE, None, "a scene"), tmp_path, (THROWN,))
    assert "worker" in told


def of_a_card_with_rows(rows: int) -> str:
    """Return a script by which textures of the graphics card have so many rows at most."""
    return (
        "const limit = WebGL2RenderingContext.prototype.getParameter;"
        "WebGL2RenderingContext.prototype.getParameter = function (name) {"
        f"  return name === this.MAX_TEXTURE_SIZE ? {rows} : limit.call(this, name);"
        "};"
    )


def test_a_scene_that_the_graphics_card_cannot_hold_gives_a_sentence(
    browser: Chromium, tmp_path: Path
) -> None:
    with Changed(browser, of_a_card_with_rows(1)):
        told = sentence(browser, page(by_hand.still(2000).encode(), None, "many"), tmp_path)
    assert "more splats than the graphics card" in told


@pytest.mark.parametrize("kind", ["offset", "sh"])
def test_curves_that_a_splat_has_no_share_of_take_no_room(
    browser: Chromium, tmp_path: Path, kind: str
) -> None:
    """Splats of a capture hardly move, and have few of the many curves that what moves needs."""
    file = by_hand.with_few_curves(kind, splats=500, curves=60)
    rows = 4  # what is needed; all pairs of a splat and a curve would be 15 and 59
    with Changed(browser, of_a_card_with_rows(rows)):
        opened(browser, file, tmp_path)
    (expected,) = drawn_by_reference(file, CAMERAS[0], 0.37, BLACK)
    assert psnr(drawn_by_page(browser, CAMERAS[0], 0.37, BLACK), expected) >= 52


def opened(browser: Chromium, file: File, folder: Path) -> None:
    path = folder / "page.html"
    path.write_text(page(file.encode(), None, "a scene"), encoding="utf-8")
    browser.open(path, 600, fragment="#paused")
    browser.evaluate("dsplat.ready")


def test_a_graphics_card_without_floats_draws_in_8_bits(browser: Chromium, tmp_path: Path) -> None:
    file = by_hand.with_bodies(24, 8)
    with Changed(browser, "WebGL2RenderingContext.prototype.getExtension = () => null"):
        opened(browser, file, tmp_path)
    assert browser.evaluate("dsplat.statistics().target") == "RGBA8"
    (expected,) = drawn_by_reference(file, CAMERAS[0], 0.4, BLACK)
    assert psnr(drawn_by_page(browser, CAMERAS[0], 0.4, BLACK), expected) >= 40


def test_it_draws_on_when_the_graphics_card_comes_back(browser: Chromium, tmp_path: Path) -> None:
    file = by_hand.with_bodies(24, 8)
    opened(browser, file, tmp_path)
    (expected,) = drawn_by_reference(file, CAMERAS[0], 0.4, BLACK)
    drawn_by_page(browser, CAMERAS[0], 0.4, BLACK)
    assert browser.evaluate(
        """(async () => {
        const canvas = document.querySelector("canvas");
        const lost = canvas.getContext("webgl2").getExtension("WEBGL_lose_context");
        const comes = (name) => new Promise((done) => canvas.addEventListener(name, done));
        const gone = comes("webglcontextlost");
        lost.loseContext();
        await gone;
        dsplat.setTime(0.1);
        await new Promise((done) => setTimeout(done, 100));
        const back = comes("webglcontextrestored");
        lost.restoreContext();
        await back;
        return true;
        })()"""
    )
    assert psnr(drawn_by_page(browser, CAMERAS[0], 0.4, BLACK), expected) >= 52
    assert not [event for event in browser.events if event.get("method") == THROWN]
