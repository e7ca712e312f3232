"""How kernels are compiled: where they are kept."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = "import numba; from gsdmsr_cli.kernels import jit; print(numba.config.CACHE_DIR)"


@pytest.mark.parametrize("first", ["", "import gsdmsr_cli.kernels.blending; "])
def test_kernels_are_kept_by_the_hash_of_all_sources_whoever_imports_numba_first(
    first: str,
) -> None:
    free = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    command = [sys.executable, "-c", first + FOLDER]
    folder = subprocess.run(command, env=free, check=True, capture_output=True, text=True).stdout
    assert len(Path(folder.strip()).name) == 16


def test_a_folder_that_the_user_names_is_used(tmp_path: Path) -> None:
    named = dict(os.environ, NUMBA_CACHE_DIR=str(tmp_path))
    command = [sys.executable, "-c", FOLDER]
    folder = subprocess.run(command, env=named, check=True, capture_output=True, text=True).stdout
    assert folder.strip() == str(tmp_path)
