"""The page in a browser: its buttons, keys, mouse and fingers, and what it does not do."""

from __future__ import annotations

import base64
from pathlib import Path
from typing import Any

import cv2
import files_by_hand as by_hand
import numpy as np
import pytest
from chromium import Chromium
from numpy.typing import NDArray

from gsdmsr_cli.player.page import page

NARROW, WIDE = 390, 700
MIDDLE = (300.0, 300.0)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "scene.html"
    path.write_text(page(by_hand.with_bodies(24, 8).encode(), None, "a scene"), encoding="utf-8")
    return path


def begin(browser: Chromium, scene: Path, width: int = WIDE, fragment: str = "#paused") -> None:
    browser.open(scene, width, fragment=fragment)
    browser.evaluate("dsplat.ready")


def pose(browser: Chromium) -> NDArray[np.float64]:
    """Return the camera's (4, 4) from world to camera, when it has come to rest."""
    browser.evaluate("new Promise((done) => setTimeout(done, 60))")
    view = "JSON.stringify(dsplat.view().world_to_camera)"
    while (found := browser.evaluate(view)) != browser.evaluate(
        f"new Promise((done) => setTimeout(done, 120)).then(() => {view})"
    ):
        pass
    return np.array(eval(found)).reshape(4, 4)


def centre(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    return -matrix[:3, :3].T @ matrix[:3, 3]


def mouse(browser: Chromium, kind: str, x: float, y: float, **more: Any) -> None:
    browser.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **more)


def drag(browser: Chromium, by: tuple[float, float], button: str = "left", **more: Any) -> None:
    (x, y), (dx, dy) = MIDDLE, by
    held = {"button": button, "buttons": 1 if button == "left" else 2, **more}
    mouse(browser, "mousePressed", x, y, clickCount=1, **held)
    for share in (0.5, 1.0):
        mouse(browser, "mouseMoved", x + share * dx, y + share * dy, **held)
    mouse(browser, "mouseReleased", x + dx, y + dy, clickCount=1, button=button)


def key(browser: Chromium, name: str, code: str, seconds: float = 0.0) -> None:
    text = {"text": name} if len(name) == 1 else {}
    browser.call("Input.dispatchKeyEvent", type="keyDown", key=name, code=code, **text)
    browser.evaluate(f"new Promise((done) => setTimeout(done, {1000 * seconds}))")
    browser.call("Input.dispatchKeyEvent", type="keyUp", key=name, code=code)


def time(browser: Chromium) -> float:
    return float(browser.evaluate("document.querySelector('#time').valueAsNumber"))


def test_it_begins_with_the_view_of_the_file(browser: Chromium, scene: Path) -> None:
    begin(browser, scene)
    found, view = pose(browser), by_hand.SCENE["view"]
    assert isinstance(view, dict)
    np.testing.assert_allclose(centre(found), view["position"], atol=1e-6)
    ahead = np.array(view["target"]) - view["position"]
    np.testing.assert_allclose(found[2, :3], ahead / np.linalg.norm(ahead), atol=1e-6)
    assert found[1, 2] < 0  # y is down, where z is up
    width, height, focal = browser.evaluate(
        "[dsplat.view().width, dsplat.view().height, dsplat.view().fy]"
    )
    assert (width, height) == (700, 900)
    assert focal == pytest.approx(350 / np.tan(0.35))  # the angle is that of the shorter side


def told(folder: Path, **scene: object) -> Path:
    """Return a page whose file tells more, or something else, of its scene."""
    file = by_hand.with_bodies(24, 8)
    file.header = {"scene": by_hand.SCENE | scene}
    path = folder / "told.html"
    path.write_text(page(file.encode(), None, "a scene"), encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("width", "angle"), [(700, 0.4), (1200, 0.7)], ids=["higher than wide", "wider than high"]
)
def test_what_was_filmed_upright_fills_a_screen_that_is_so(
    browser: Chromium, tmp_path: Path, width: int, angle: float
) -> None:
    begin(browser, told(tmp_path, view={"fov_x": 0.4, "fov_y": 0.7}), width)
    focal = browser.evaluate("dsplat.view().fy")
    assert focal == pytest.approx(min(width, 900) / 2 / np.tan(angle / 2))


PATH = [
    {"time": 0.0, "position": [0, -4, 1], "target": [0, 0, 0], "up": [0, 0, 1]},
    {"time": 0.5, "position": [3, -4, 1], "target": [3, 0, 0], "up": [0, 0, 1]},
    {"time": 1.0, "position": [3, -2, 1], "target": [3, 2, 0], "up": [0, 0, 1]},
]


def test_the_camera_goes_along_its_path_until_somebody_moves_it(
    browser: Chromium, tmp_path: Path
) -> None:
    begin(browser, told(tmp_path, path=PATH))
    for moment, place in (
        (0.0, [0, -4, 1]),
        (0.25, [1.5, -4, 1]),
        (0.9, [3, -2.4, 1]),
        (1, [3, -2, 1]),
    ):
        browser.evaluate(f"dsplat.setTime({moment})")
        np.testing.assert_allclose(centre(pose(browser)), place, atol=1e-6)
    drag(browser, (40, 0))
    left = centre(pose(browser))
    browser.evaluate("dsplat.setTime(0.25)")
    np.testing.assert_allclose(centre(pose(browser)), left, atol=1e-6)
    key(browser, "r", "KeyR")
    np.testing.assert_allclose(centre(pose(browser)), [1.5, -4, 1], atol=1e-6)


@pytest.mark.parametrize(
    "path", [None, [], PATH[:1], PATH[::-1], [*PATH, {"time": 2}], [*PATH, None], "far"]
)
def test_a_path_that_is_none_is_left_out(browser: Chromium, tmp_path: Path, path: object) -> None:
    begin(browser, told(tmp_path, path=path))
    browser.evaluate("dsplat.setTime(0.7)")
    np.testing.assert_allclose(centre(pose(browser)), [0, -4, 1], atol=1e-6)


def test_dragging_turns_about_the_target_and_not_over_the_top(
    browser: Chromium, scene: Path
) -> None:
    begin(browser, scene)
    before = pose(browser)
    drag(browser, (80, 0))
    after = pose(browser)
    np.testing.assert_allclose(centre(after)[2], centre(before)[2], atol=1e-6)
    assert np.linalg.norm(centre(after)) == pytest.approx(np.linalg.norm(centre(before)))
    assert centre(after)[0] < -0.5  # what is in front follows the pointer to the right
    for _ in range(4):
        drag(browser, (0, 300))
    above = pose(browser)
    assert above[2, 2] < -0.99 and above[1, 2] < 0
    np.testing.assert_allclose(above[:3, :3] @ above[:3, :3].T, np.eye(3), atol=1e-9)


@pytest.mark.parametrize("more", [{"button": "right"}, {"modifiers": 8}])
def test_dragging_otherwise_moves_sideways(
    browser: Chromium, scene: Path, more: dict[str, Any]
) -> None:
    begin(browser, scene)
    before = pose(browser)
    drag(browser, (100, 0), **more)
    after = pose(browser)
    np.testing.assert_allclose(after[:3, :3], before[:3, :3], atol=1e-9)
    focal = 350 / np.tan(0.35)
    distance = float(np.linalg.norm(centre(before)))  # to the target, which is the origin
    assert after[0, 3] - before[0, 3] == pytest.approx(100 * distance / focal)


def test_wheel_and_reset(browser: Chromium, scene: Path) -> None:
    begin(browser, scene)
    before = pose(browser)
    mouse(browser, "mouseWheel", *MIDDLE, deltaX=0, deltaY=-200)
    after = pose(browser)
    assert np.linalg.norm(centre(after)) < 0.9 * np.linalg.norm(centre(before))
    drag(browser, (50, 50))
    key(browser, "r", "KeyR")
    np.testing.assert_allclose(pose(browser), before, atol=1e-6)


def test_keys_fly(browser: Chromium, scene: Path) -> None:
    begin(browser, scene)
    for code, axis, sign in (("KeyW", 2, 1), ("KeyA", 0, -1), ("KeyE", 1, -1)):
        before = pose(browser)
        key(browser, code[-1].lower(), code, 0.3)
        way = before[:3, :3] @ (centre(pose(browser)) - centre(before))
        assert sign * way[axis] > 0.02 and abs(np.delete(way, axis)).max() < 1e-9, code


def test_fingers_turn_pinch_and_move(browser: Chromium, scene: Path) -> None:
    begin(browser, scene, NARROW)
    before = pose(browser)
    browser.drag((200, 400), (260, 400))
    turned = pose(browser)
    assert centre(turned)[0] < -0.3
    for kind, half in (("touchStart", 40), ("touchMove", 60), ("touchMove", 80)):
        points = [{"x": 200 - half, "y": 400, "id": 1}, {"x": 200 + half, "y": 400, "id": 2}]
        browser.call("Input.dispatchTouchEvent", type=kind, touchPoints=points)
    browser.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
    nearer = pose(browser)
    lengths = [np.linalg.norm(centre(one)) for one in (before, nearer)]
    assert lengths[1] / lengths[0] == pytest.approx(0.5, rel=0.02)
    np.testing.assert_allclose(nearer[:3, :3], turned[:3, :3], atol=1e-9)


def test_a_double_click_makes_a_place_the_target(browser: Chromium, tmp_path: Path) -> None:
    file = by_hand.still(2)
    file.tables |= {
        "means": np.array([[0.0, 0.0, 0.0], [0.6, 0.5, 0.0]]), "opacities": np.ones((2, 1)),
        "log_scales": np.full((2, 3), np.log(0.15)),
    }  # fmt: skip
    path = tmp_path / "two.html"
    path.write_text(page(file.encode(), None, "two"), encoding="utf-8")
    begin(browser, path)
    before = pose(browser)
    seen = before[:3, :3] @ [0.6, 0.5, 0.0] + before[:3, 3]
    focal = 350 / np.tan(0.35)
    x, y = 350 + focal * seen[0] / seen[2], 450 + focal * seen[1] / seen[2]
    for count in (1, 2):
        for kind in ("mousePressed", "mouseReleased"):
            mouse(browser, kind, x, y, button="left", clickCount=count)
    after = pose(browser)
    found = after[:3, :3] @ [0.6, 0.5, 0.0] + after[:3, 3]
    np.testing.assert_allclose(found, [0, 0, seen[2]], atol=5e-3)
    np.testing.assert_allclose(after[:3, :3], before[:3, :3], atol=1e-9)


def test_the_timeline_plays_pauses_and_steps(browser: Chromium, scene: Path) -> None:
    begin(browser, scene, fragment="#paused&speed=0.25")
    assert time(browser) == 0
    key(browser, " ", "Space")
    browser.evaluate("new Promise((done) => setTimeout(done, 400))")
    key(browser, " ", "Space")
    played = time(browser)
    assert 0 < played < 0.9  # of eight seconds
    browser.evaluate("new Promise((done) => setTimeout(done, 200))")
    assert time(browser) == played
    key(browser, "ArrowRight", "ArrowRight")
    assert time(browser) == pytest.approx(played + 1 / 60)
    key(browser, "End", "End")
    assert time(browser) == 1
    assert browser.evaluate("document.querySelector('#clock').textContent") == "2.00 / 2.00 s"
    key(browser, "l", "KeyL")
    for _ in range(4):
        key(browser, ".", "Period")
    assert browser.evaluate("document.querySelector('#speed').value") == "4"
    browser.evaluate("document.querySelector('#play').click()")
    label = "document.querySelector('#play').ariaLabel"
    for _ in range(100):
        browser.evaluate("new Promise((done) => setTimeout(done, 100))")
        if browser.evaluate(label) == "Play (space)":
            break
    assert time(browser) == 1  # once from the start, and no more


def test_it_plays_by_itself_and_as_the_address_says(browser: Chromium, scene: Path) -> None:
    begin(browser, scene, fragment="#speed=2")
    assert browser.evaluate("document.querySelector('#play').ariaLabel") == "Pause (space)"
    for _ in range(50):  # a busy machine is slow to show the first frames
        browser.evaluate("new Promise((done) => setTimeout(done, 100))")
        if time(browser) > 0.02:
            break
    assert time(browser) > 0.02
    begin(browser, scene, fragment="#bare&time=0.25&background=white")
    assert time(browser) == 0.25
    for name in ("tools", "timeline"):
        shown = browser.evaluate(f"getComputedStyle(document.querySelector('#{name}')).display")
        assert shown == "none"
    browser.evaluate("dsplat.draw()")
    corner = "dsplat.pixels().then((pixels) => [...pixels.subarray(0, 3)])"
    assert browser.evaluate(corner) == [255, 255, 255]


def test_nothing_is_drawn_while_nothing_changes(browser: Chromium, scene: Path) -> None:
    begin(browser, scene)
    pose(browser)
    before = browser.evaluate("dsplat.statistics().frames")
    browser.evaluate("new Promise((done) => setTimeout(done, 500))")
    assert browser.evaluate("dsplat.statistics().frames") == before
    key(browser, "b", "KeyB")
    browser.evaluate("new Promise((done) => setTimeout(done, 200))")
    assert browser.evaluate("dsplat.statistics().frames") == before + 1


def test_backgrounds_and_help(browser: Chromium, scene: Path) -> None:
    begin(browser, scene)
    corners = []
    for _ in range(3):
        corners.append(
            browser.evaluate("dsplat.pixels().then((pixels) => [...pixels.subarray(0, 3)])")
        )
        browser.evaluate("document.querySelector('#background').click()")
    assert corners[1:] == [[255] * 3, [0] * 3]
    np.testing.assert_allclose(corners[0], 255 * np.array(by_hand.SCENE["background"]), atol=1)
    opened = "document.querySelector('#help').open"
    key(browser, "h", "KeyH")
    assert browser.evaluate(opened) is True
    browser.press("Escape", 27)
    assert browser.evaluate(opened) is False


def test_a_picture_is_saved_as_it_is_shown(browser: Chromium, scene: Path) -> None:
    begin(browser, scene, fragment="#time=0.5")
    name, url = browser.evaluate(
        """(async () => {
        const link = new Promise((done) => {
          HTMLAnchorElement.prototype.click = function () { done([this.download, this.href]); };
        });
        document.querySelector("#screenshot").click();
        const [name, url] = await link;
        const image = new Image();
        image.src = url;
        await image.decode();
        const canvas = Object.assign(document.createElement("canvas"),
          { width: image.width, height: image.height });
        canvas.getContext("2d").drawImage(image, 0, 0);
        return [name, canvas.toDataURL()];
        })()"""
    )
    assert name == "a scene at 0.500.png"
    data = np.frombuffer(base64.b64decode(url.split(",")[1]), np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert picture.shape == (900, 700, 3) and np.ptp(picture) > 100


def test_another_file_takes_the_place_of_one_and_camera_and_time_stay(
    browser: Chromium, scene: Path
) -> None:
    begin(browser, scene, fragment="#time=0.5")
    drag(browser, (60, 20))
    before = pose(browser)
    data = base64.b64encode(by_hand.with_own_curves().encode()).decode()
    load = "dsplat.load(Uint8Array.from(atob('{}'), (letter) => letter.charCodeAt(0)))"
    pixels = "dsplat.pixels().then((pixels) => pixels.reduce((sum, value) => sum + value, 0))"
    sums = [browser.evaluate(pixels)]
    browser.evaluate(load.format(data))
    sums.append(browser.evaluate(pixels))
    refused = load.format(base64.b64encode(b"nonsense").decode())
    assert browser.evaluate(f"{refused}.then(() => null, (error) => error.message)")
    sums.append(browser.evaluate(pixels))
    assert sums[0] != sums[1] == sums[2]
    np.testing.assert_array_equal(pose(browser), before)
    assert time(browser) == 0.5 and browser.evaluate("dsplat.statistics().splats") == 160


@pytest.mark.parametrize("width", [NARROW, WIDE])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_it_fits_the_screen_and_asks_for_nothing(
    browser: Chromium, scene: Path, width: int, scheme: str
) -> None:
    browser.open(scene, width, scheme)
    browser.evaluate("dsplat.ready")
    asked = [
        event["params"]["request"]["url"]
        for event in browser.events
        if event.get("method") == "Network.requestWillBeSent"
    ]
    assert asked[0] == scene.as_uri()
    assert all(url.startswith(("data:", "blob:")) for url in asked[1:]), asked
    told = ("Log.entryAdded", "Runtime.exceptionThrown", "Runtime.consoleAPICalled")
    assert not [event for event in browser.events if event.get("method") in told]
    boxes = browser.evaluate(
        "[...document.querySelectorAll('button, select, input')].filter((e) => e.offsetParent)"
        ".map((e) => e.getBoundingClientRect()).map((b) => [b.left, b.top, b.right, b.bottom])"
    )
    assert len(boxes) >= 8
    for left, top, right, bottom in boxes:
        assert 0 <= left < right <= width and 0 <= top < bottom <= 900
    unnamed = "[...document.querySelectorAll('button, select, input')].filter((e) => !(e.ariaLabel || e.textContent.trim())).length"  # noqa: E501
    assert browser.evaluate(unnamed) == 0
