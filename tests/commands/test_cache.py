"""gsdmsr cache: finds what is kept, and removes only that."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from gsdmsr_cli.backends.cpu import jit
from gsdmsr_cli.commands import cache
from gsdmsr_cli.evaluation.lpips_trunks import ARCHITECTURES
from gsdmsr_cli.ground import say

HASH, OTHER = "0123456789abcdef", "f" * 16


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine with kernels, weights, and files of others beside them."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))
    monkeypatch.setattr(jit, "HERE", tmp_path / "package")
    weights = tmp_path / "torch" / "hub" / "checkpoints"
    files = {
        tmp_path / "package" / "__pycache__" / HASH / "k" / "a.nbi": 10,
        tmp_path / "package" / "__pycache__" / "jit.cpython-311.pyc": 1000,
        tmp_path / "cache" / "gsdmsr" / OTHER / "b.nbc": 20,
        tmp_path / "cache" / "gsdmsr" / "notes.txt": 1000,
        tmp_path / "cache" / "gsdmsr" / "cuda" / HASH / "c.cubin": 30,
        tmp_path / "cache" / "gsdmsr" / "frames" / HASH / "cam00" / "images" / "0000.png": 50,
        tmp_path / "cache" / "others" / HASH / "d": 1000,
        weights / ARCHITECTURES["alex"].checkpoint: 40,
        weights / "somebody-elses.pth": 1000,
    }
    for path, size in files.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(bytes(size))
    (tmp_path / "cache" / "gsdmsr" / ("e" * 16)).symlink_to(tmp_path / "cache" / "others")
    return tmp_path


def answer(capsys: pytest.CaptureFixture[str], *options: bool) -> dict[str, Any]:
    with say.on_its_own(as_json=True):
        cache.run(*options)
    return dict(json.loads(capsys.readouterr().out))


def sizes(entries: list[dict[str, Any]]) -> dict[str, list[int]]:
    found: dict[str, list[int]] = {}
    for entry in entries:
        found.setdefault(entry["kind"], []).append(entry["bytes"])
    return found


ALL = {"kernels": [10, 20], "GPU kernels": [30], "frames": [50], "LPIPS weights": [40]}


def test_what_is_kept_is_listed_and_stays(home: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = sorted(home.rglob("*"))
    found = answer(capsys)
    assert sizes(found["kept"]) == ALL and found["removed"] == []
    assert sorted(home.rglob("*")) == before
    cache.run()
    assert "kept: 0.0 MB" in capsys.readouterr().out


@pytest.mark.parametrize(("weights", "frames"), [(False, False), (True, False), (False, True)])
def test_only_what_is_ours_is_removed(
    home: Path, weights: bool, frames: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    found = answer(capsys, True, weights, frames)
    kept = {"frames": [50]} if not frames else {}
    kept |= {"LPIPS weights": [40]} if not weights else {}
    assert sizes(found["kept"]) == kept
    assert sizes(found["removed"]) == {k: v for k, v in ALL.items() if k not in kept}
    left = {path.name for path in home.rglob("*") if path.is_file()}
    others = {"jit.cpython-311.pyc", "notes.txt", "d", "somebody-elses.pth"}
    spared = {"0000.png": frames, ARCHITECTURES["alex"].checkpoint: weights}
    assert left == others | {name for name, removed in spared.items() if not removed}
    assert answer(capsys)["removed"] == []


def test_the_kernels_of_this_version_are_where_it_looks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NUMBA_CACHE_DIR")  # by it, a user puts them elsewhere
    folder = jit._cache_folder()
    assert folder.parent in (jit.HERE / "__pycache__", cache.cache_home())
    assert cache._NAME.fullmatch(folder.name)
