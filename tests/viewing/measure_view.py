"""Prints what a page costs a training: PYTHONPATH=. python tests/viewing/measure_view.py DATA.

The same training, to the last bit, is made in turns: without a page, with one that nobody looks at,
and with one that a client looks at as a browser on another machine does, with all that its page
asks for. What starting the server takes is told apart: steps count from when it runs.
"""

from __future__ import annotations

import json
import re
import statistics
import subprocess
import sys
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

TURNS, STEPS, FROM = 7, 6000, 2000
"""How often each is trained, for how many steps, and from which one on time is taken."""

EVERY = 2.0
"""Between two questions of a page [s], see ``player/live.js``."""

OPTIONS = "--preset", "dnerf", "--downscale", "2", "--steps", str(STEPS), "--json"

WAYS = "no page", "page, nobody looks", "page, somebody looks"


def measured(data: Path, out: Path, way: str) -> tuple[float, float]:
    """Train; return steps per minute while the server runs, and how long all took [s]."""
    line = [sys.executable, "-m", "gsdmsr_cli", "train", "--data", str(data), "--out", str(out)]
    further = [] if way == WAYS[0] else ["--view"]
    log = out.with_suffix(".log")
    with log.open("wb") as shown:
        training = subprocess.Popen(
            [*line, *OPTIONS, *further], stdout=subprocess.PIPE, stderr=shown
        )
        if way == WAYS[2]:
            threading.Thread(target=_look, args=(training, log), daemon=True).start()
        answer, _ = training.communicate()
    if training.returncode:
        raise SystemExit(log.read_text(encoding="utf-8"))
    reports = [json.loads(text) for text in (out / "metrics.jsonl").read_text().splitlines()]
    first = next(report for report in reports if report["step"] >= FROM)
    took = reports[-1]["elapsed"] - first["elapsed"]
    return 60 * (reports[-1]["step"] - first["step"]) / took, json.loads(answer)["train_s"]


def _look(training: subprocess.Popen[bytes], log: Path) -> None:
    """Ask for what a page asks for, and fetch splats and pictures when there are newer ones."""
    before = None
    while training.poll() is None:
        time.sleep(EVERY)
        found = re.search(r"http://\S+", log.read_text(encoding="utf-8"))
        if found is None:
            continue
        try:
            scene = json.loads(_fetched(found[0] + "state.json"))["scene"]
            if scene != before:
                for name in ("scene.dsplat", "drawn.png", "truth.png"):
                    _fetched(found[0] + name)
            before = scene
        except OSError:  # it has ended
            return


def _fetched(address: str) -> bytes:
    with urllib.request.urlopen(address, timeout=30) as answer:
        data: bytes = answer.read()
    return data


def main() -> None:
    """Print a table."""
    found: dict[str, list[tuple[float, float]]] = {way: [] for way in WAYS}
    with tempfile.TemporaryDirectory() as name:
        for turn in range(TURNS):
            for way in WAYS[turn % 3 :] + WAYS[: turn % 3]:
                out = Path(name) / f"{turn}{WAYS.index(way)}"
                found[way].append(measured(Path(sys.argv[1]), out, way))
                print(turn + 1, way, found[way][-1], file=sys.stderr, flush=True)
    medians = {
        way: [statistics.median(column) for column in zip(*values, strict=True)]
        for way, values in found.items()
    }
    print("| | steps a minute | against no page | training in all [s] |\n|---|---:|---:|---:|")
    for way, (speed, whole) in medians.items():
        against = 100 * (speed / medians[WAYS[0]][0] - 1)
        print(f"| {way} | {speed:.0f} | {against:+.1f} % | {whole:.1f} |")


if __name__ == "__main__":
    main()
