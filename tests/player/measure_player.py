"""Prints how long the page takes: PYTHONPATH=.:tests python tests/player/measure_player.py."""

from __future__ import annotations

import tempfile
from pathlib import Path

from chromium import Chromium, find_chromium
from files_by_hand import many

from gsdmsr_cli.player.page import page

SIZES = 10_000, 100_000, 300_000
SECONDS = 5
"""Of playing, for each."""

SCREEN = 600, 400


def measured(browser: Chromium, count: int, folder: Path) -> dict[str, float]:
    """Return the page's figures, and how long its scripts have the processor for a frame."""
    path = folder / f"{count}.html"
    path.write_text(page(many(count).encode(), None, str(count)), encoding="utf-8")
    width, height = SCREEN
    browser.open(path, width, fragment="#paused", height=height)
    browser.evaluate("dsplat.ready.then(() => dsplat.play())")
    before = _so_far(browser)
    browser.evaluate(f"new Promise((done) => setTimeout(done, {1000 * SECONDS}))")
    after = _so_far(browser)
    frames = max(1, after[1] - before[1])
    found = dict(browser.evaluate("dsplat.statistics()"))
    return found | {"cpu_ms": 1000 * (after[0] - before[0]) / frames, "played": frames}


def _so_far(browser: Chromium) -> tuple[float, int]:
    """Return how long scripts have had a processor [s], and how many frames they have made."""
    metrics = browser.call("Performance.getMetrics")["metrics"]
    took = next(metric["value"] for metric in metrics if metric["name"] == "ScriptDuration")
    return float(took), int(browser.evaluate("dsplat.statistics().frames"))


def main() -> None:
    """Print a table."""
    columns = "decode_ms", "first_picture_ms", "script_ms", "cpu_ms", "sort_ms", "played"
    print("| splats | bytes |", " | ".join(name.replace("_", " ") for name in columns), "|")
    binary = find_chromium()
    assert binary, "no Chromium"
    with tempfile.TemporaryDirectory() as name, Chromium(binary, Path(name) / "profile") as browser:
        browser.call("Performance.enable", timeDomain="threadTicks")
        measured(browser, 100, Path(name))  # the browser's own beginnings
        for count in SIZES:
            found = measured(browser, count, Path(name))
            values = [f"{found['bytes'] / 1e6:.2f} M", *(f"{found[c]:.1f}" for c in columns)]
            print(f"| {count:,} |", " | ".join(values), "|", flush=True)


if __name__ == "__main__":
    main()
