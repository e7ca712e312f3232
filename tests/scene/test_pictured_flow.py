"""Flow between pictures: how far what they show has gone, and how it is kept."""

from __future__ import annotations

import errno
import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from view_checks import SIZE, shifted_pictures

from gsdmsr_cli.scene import pictured_flow
from gsdmsr_cli.scene.pictured_flow import PicturedFlow
from gsdmsr_cli.scene.pictures import Pictures


def test_pictures_say_how_far_what_they_show_has_gone(tmp_path: Path) -> None:
    pictures, (first, second) = shifted_pictures(tmp_path)
    for view, other, way in ((first, second, 3.0), (second, first, -3.0)):
        found = PicturedFlow().between(pictures, view, other)
        sure = np.isfinite(found).all(axis=2)
        assert found.shape == (SIZE, SIZE, 2) and sure[8:-8, 8:-8].mean() > 0.9
        np.testing.assert_allclose(np.median(found[sure], axis=0), [way, 0.0], atol=0.2)
        leaving = found[:, -1, 0] if way > 0 else found[:, 0, 0]
        assert np.isnan(leaving).all(), "what leaves the picture cannot be followed"


def test_flow_is_kept_in_files_and_made_again_where_one_is_damaged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures, (first, second) = shifted_pictures(tmp_path)
    flow, again = PicturedFlow(), PicturedFlow()
    flow.folder = again.folder = tmp_path / "run" / "flow"
    expected = PicturedFlow().between(pictures, first, second)
    np.testing.assert_array_equal(flow.between(pictures, first, second), expected)
    assert not flow.folder.exists(), "nor is a run folder made that is not there"
    flow.folder.parent.mkdir()
    flow.between(pictures, first, second)
    (kept,) = flow.folder.iterdir()
    calls: list[int] = []
    whole = pictured_flow.optical_flow
    monkeypatch.setattr(pictured_flow, "optical_flow", lambda *a: calls.append(1) or whole(*a))
    for known in (flow, again):
        np.testing.assert_array_equal(known.between(pictures, first, second), expected)
    assert not calls
    whole_file = kept.read_bytes()
    spoilt = whole_file[:200] + bytes(9) + whole_file[209:]
    other = io.BytesIO()
    np.savez(other, flow=np.zeros((2, 2, 2), np.float16))
    for damaged in (whole_file[:-7], spoilt, b"", b"\x93NUMPY", other.getvalue()):
        kept.write_bytes(damaged)
        np.testing.assert_array_equal(again.between(pictures, first, second), expected)
        assert calls and kept.read_bytes() == whole_file
        calls.clear()


def test_pictures_too_small_for_a_flow_have_none(tmp_path: Path) -> None:
    _, (first, second) = shifted_pictures(tmp_path)
    small = Pictures((1.0, 1.0, 1.0), 3, 1 << 20)
    found = PicturedFlow().between(small, first, second)
    assert found.shape == (21, 21, 2) and np.isnan(found).all()


def test_a_disk_that_takes_no_flow_ends_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures, (first, second) = shifted_pictures(tmp_path)

    def full(*_: Any, **__: Any) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(pictured_flow.np, "savez_compressed", full)
    flow = PicturedFlow()
    flow.folder = tmp_path / "flow"
    assert np.isfinite(flow.between(pictures, first, second)).any()
    assert not list(flow.folder.iterdir())
