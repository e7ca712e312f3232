"""The page in a real browser, from file:// and without a network: narrow, wide, light and dark."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from chromium import Chromium
from report_pages import write_page

NARROW, WIDE = 390, 1440


@pytest.fixture(scope="module")
def report(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_page(tmp_path_factory.mktemp("report") / "report.html")


@pytest.mark.parametrize("width", [NARROW, WIDE])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_the_screen_and_asks_for_nothing(
    browser: Chromium, report: Path, tmp_path: Path, width: int, scheme: str
) -> None:
    browser.open(report, width, scheme)
    asked = [
        event["params"]["request"]["url"]
        for event in browser.events
        if event.get("method") == "Network.requestWillBeSent"
    ]
    assert asked[0] == report.as_uri() and all(url.startswith("data:") for url in asked[1:])
    told = ("Log.entryAdded", "Runtime.exceptionThrown", "Runtime.consoleAPICalled")
    assert not [event for event in browser.events if event.get("method") in told]
    assert browser.evaluate("document.documentElement.scrollWidth") == width
    loaded = "[...document.images].every(image => image.naturalWidth > 0)"
    assert browser.evaluate(loaded) is True
    path = tmp_path / "page.png"
    browser.screenshot(path)
    pixels = cv2.imread(str(path))
    assert pixels.shape[1] == width and pixels.shape[0] > 1000
    corner = pixels[-5:, :5].mean()
    assert corner > 230 if scheme == "light" else corner < 40
    assert np.unique(pixels.reshape(-1, 3), axis=0).shape[0] > 500  # charts, text and pictures


def divider(browser: Chromium) -> float:
    """Return where the divider of the frame that is seen stands, in per cent."""
    shot = '[...document.querySelectorAll(".shot")].find(s => s.offsetParent)'
    at = f'getComputedStyle({shot}.querySelector(".compare")).getPropertyValue("--at")'
    clip = browser.evaluate(f'getComputedStyle({shot}.querySelector(".drawn")).clipPath')
    value = str(browser.evaluate(at))
    assert value.endswith("%") and value in clip
    return float(value[:-1])


def test_the_divider_follows_the_keyboard(browser: Chromium, report: Path) -> None:
    browser.open(report, WIDE)
    assert divider(browser) == 50
    browser.evaluate('document.querySelector(".compare input").focus()')
    for _ in range(3):
        browser.press("ArrowRight", 39)
    assert divider(browser) == 53
    browser.press("Home", 36)
    assert divider(browser) == 0
    browser.press("End", 35)
    assert divider(browser) == 100


def test_the_divider_follows_a_finger(browser: Chromium, report: Path) -> None:
    browser.open(report, NARROW)
    box = browser.evaluate(
        '(() => { const c = document.querySelector(".compare"); c.scrollIntoView();'
        " const b = c.getBoundingClientRect(); return [b.x, b.y, b.width, b.height]; })()"
    )
    left, top, width, height = box
    row = top + height / 3
    browser.drag((left + width / 2, row), (left + 0.2 * width, row))
    assert divider(browser) == pytest.approx(20, abs=2)


def test_another_frame_is_chosen_by_the_keyboard_or_a_click(
    browser: Chromium, report: Path
) -> None:
    browser.open(report, WIDE)
    seen = '[...document.querySelectorAll(".shot")].filter(s => s.offsetParent).map(s => s.id)'
    assert browser.evaluate(seen) == ["f0"]
    browser.evaluate('document.querySelector("#s0").focus()')
    browser.press("ArrowRight", 39)
    assert browser.evaluate(seen) == ["f1"]
    browser.evaluate("document.querySelector('label[for=s0]').click()")
    assert browser.evaluate(seen) == ["f0"]
