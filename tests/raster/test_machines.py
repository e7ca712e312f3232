"""The same picture on any number of threads, and nearly the same on any processor."""

from __future__ import annotations

import os
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from draw_apart import NAMES

HERE = Path(__file__).parent


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("drawn")


@cache
def drawn_apart(folder: Path, **environment: str) -> dict[str, np.ndarray]:
    """Return what a process draws in an environment."""
    path = folder / f"{'-'.join(environment.values())}.npz"
    inherited = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CPU_NAME",)}
    line = [sys.executable, str(HERE / "draw_apart.py"), str(path)]
    done = subprocess.run(
        line, env=inherited | environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    with np.load(path) as file:
        return dict(file)


def numbers_of(drawn: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    numbers = {name: array for name, array in drawn.items() if "/" in name}
    assert len(numbers) == 11 * len(NAMES)
    assert all(np.isfinite(array).all() for array in numbers.values())
    return numbers


@pytest.mark.parametrize("threads", ["2", "3", "7"])
def test_results_do_not_depend_on_the_number_of_threads(folder: Path, threads: str) -> None:
    """Bit by bit, and with more threads than there are parts of the backward pass."""
    one = drawn_apart(folder, NUMBA_NUM_THREADS="1")
    many = drawn_apart(folder, NUMBA_NUM_THREADS=threads)
    assert one["threads"].tolist() == [1, 1]
    assert many["threads"].tolist() == [int(threads)] * 2
    found = numbers_of(many)
    for name, array in numbers_of(one).items():
        assert np.array_equal(found[name], array), name


def test_a_processor_without_avx_draws_the_same(folder: Path) -> None:
    """Numba compiles for the least x86-64, or the least of whatever this is: SSE2, no FMA."""
    here = drawn_apart(folder, NUMBA_NUM_THREADS="1")
    plain = drawn_apart(folder, NUMBA_NUM_THREADS="1", NUMBA_CPU_NAME="generic")
    target = str(plain["target"])
    assert "generic" in target and "+avx" not in target and "+fma" not in target
    assert target != str(here["target"])
    found = numbers_of(plain)
    for name, array in numbers_of(here).items():
        if "/d_" in name:
            error = np.linalg.norm(found[name] - array)
            assert error <= 1e-4 * np.linalg.norm(array) + 1e-7, name
        else:
            np.testing.assert_allclose(found[name], array, atol=1e-5, rtol=1e-4, err_msg=name)
