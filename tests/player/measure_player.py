"""Prints how long the page takes: PYTHONPATH=.:tests python tests/player/measure_player.py."""

from __future__ import annotations

import tempfile
from pathlib import Path

from chromium import Chromium, find_chromium
from files_by_hand import many

from gsdmsr_cli.player.page import page

SIZES = 10_000, 100_000, 300_000
SECONDS = 8
"""Of playing, for each."""


def measured(browser: Chromium, count: int, folder: Path) -> dict[str, float]:
    """Return the page's own figures after it has played for a while."""
    path = folder / f"{count}.html"
    path.write_text(page(many(count).encode(), None, str(count)), encoding="utf-8")
    browser.open(path, 600, fragment="#paused", height=400)
    browser.evaluate("dsplat.ready.then(() => dsplat.play())")
    wait = f"new Promise((done) => setTimeout(done, {1000 * SECONDS}))"
    return dict(browser.evaluate(f"{wait}.then(() => dsplat.statistics())"))


def main() -> None:
    """Print a table."""
    columns = "bytes", "decode_ms", "first_picture_ms", "script_ms", "sort_ms"
    print("| splats |", " | ".join(name.replace("_", " ") for name in columns), "|")
    binary = find_chromium()
    assert binary, "no Chromium"
    with tempfile.TemporaryDirectory() as name, Chromium(binary, Path(name) / "profile") as browser:
        measured(browser, 100, Path(name))  # the browser's own beginnings
        for count in SIZES:
            found = measured(browser, count, Path(name))
            values = [f"{found['bytes'] / 1e6:.2f} M", *(f"{found[c]:.1f}" for c in columns[1:])]
            print(f"| {count:,} |", " | ".join(values), "|", flush=True)


if __name__ == "__main__":
    main()
