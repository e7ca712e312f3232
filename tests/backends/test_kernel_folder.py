"""Where compiled kernels are kept, if no folder can be written."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import pytest

from gsdmsr_cli.backends.kernel_folder import choose_folder
from gsdmsr_cli.ground.errors import DataError

NOWHERE = Path("/dev/null/nowhere")


def test_the_first_that_can_be_written_is_taken_and_not_made(tmp_path: Path, capsys: Any) -> None:
    found = choose_folder([NOWHERE, tmp_path / "a" / "b", tmp_path])
    assert found == tmp_path / "a" / "b" and not (tmp_path / "a").exists()
    assert capsys.readouterr().err == ""


def test_without_any_place_it_is_said_what_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(**_: Any) -> str:
        raise FileNotFoundError(2, "No usable temporary directory found")

    monkeypatch.setattr(tempfile, "mkdtemp", refuse)
    with pytest.raises(DataError, match=r"No usable temporary .*; set NUMBA_CACHE_DIR to a folder"):
        choose_folder([NOWHERE])
