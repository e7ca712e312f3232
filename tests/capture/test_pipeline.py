"""Which stages of a preparation are made anew when an option has changed."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from gsdmsr_cli.capture import prepare
from gsdmsr_cli.capture.options import Options
from gsdmsr_cli.capture.prepare import _Pipeline

STAGES = ("frames", "features", "matches", "model", "between")

CHANGES: dict[str, tuple[Any, str]] = {
    "frames": (33, "frames"),
    "max_side": (333, "frames"),
    "offsets": ({"cam00": 1.5}, "frames"),
    "features": (3333, "features"),
    "camera_model": ("OPENCV", "matches"),
    "matching": ("exhaustive", "matches"),
    "keyframes": (33, "matches"),
    "seed": (3, "matches"),
    "mapping": ("incremental", "model"),
}
"""By option another value, and the first stage that depends on it."""


class Asked:
    """Stages that are never made, and the keys that they were asked for with."""

    def __init__(self) -> None:
        self.keys: dict[str, dict[str, Any]] = {}

    def run(self, name: str, key: dict[str, Any], make: object) -> Path:
        self.keys[name] = dict(key)
        return Path(name)


def frames_of(count: int) -> Any:
    """Frames of which fewer may be chosen."""
    return SimpleNamespace(names=("a.png",) * count, some=frames_of)


def keys_with(options: Options, monkeypatch: pytest.MonkeyPatch) -> dict[str, dict[str, Any]]:
    monkeypatch.setattr(prepare, "read_frames", lambda folder: frames_of(240))
    monkeypatch.setattr(prepare, "read_reconstruction", lambda folder: None)
    monkeypatch.setattr(prepare, "with_placed", lambda found, folder: None)
    monkeypatch.setattr(prepare, "versions", lambda: {"colmap": "1"})
    asked: Any = Asked()
    source: Any = SimpleNamespace(kind="video", digest=lambda: "abc")
    pipeline = _Pipeline(source, options, asked, lambda _: nullcontext(lambda *_: None))
    pipeline.find_cameras(*pipeline.find_frames(), None)
    return asked.keys


@pytest.mark.parametrize("option", CHANGES)
def test_a_stage_and_all_after_it_depend_on_an_option(
    option: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    value, first = CHANGES[option]
    plain = Options()
    assert getattr(plain, option) != value
    before = keys_with(plain, monkeypatch)
    after = keys_with(replace(plain, **{option: value}), monkeypatch)
    assert tuple(before) == tuple(after) == STAGES
    differing = [stage for stage in STAGES if before[stage] != after[stage]]
    assert differing == list(STAGES[STAGES.index(first) :])
