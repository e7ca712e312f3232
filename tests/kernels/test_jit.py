"""How kernels are compiled: where they are kept."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gsdmsr_cli.kernels import jit

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


@pytest.fixture
def empty_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    if not sys.platform.startswith("linux"):
        pytest.skip("processes are forked on Linux alone")
    jit.threads()
    if not jit.may_fork():
        pytest.skip("kernels do not run in a forked process here")
    monkeypatch.setattr(jit.numba.config, "CACHE_DIR", str(tmp_path / "cache"))
    return tmp_path


def test_works_are_done_apart_and_only_once(empty_cache: Path) -> None:
    def work(name: str) -> None:
        (empty_cache / name).write_text(str(os.getpid()))

    jit.compile_apart("x", [lambda: work("one"), lambda: work("two")])
    pids = {(empty_cache / name).read_text() for name in ("one", "two")}
    assert len(pids) == 2 and str(os.getpid()) not in pids
    jit.compile_apart("x", [lambda: work("three")])
    assert not (empty_cache / "three").exists()
    jit.compile_apart("y", [lambda: work("three")])
    assert (empty_cache / "three").exists()


def test_a_work_that_fails_is_done_again(empty_cache: Path) -> None:
    jit.compile_apart("x", [lambda: os._exit(1)])
    jit.compile_apart("x", [(empty_cache / "again").touch])
    assert (empty_cache / "again").exists()
