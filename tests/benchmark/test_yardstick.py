"""Other kernels are given our splats, and the steps that ours make."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from gsdmsr_cli.benchmark import yardstick
from gsdmsr_cli.benchmark.cloud import cloud
from gsdmsr_cli.ground.errors import DataError

ITER = """
import numpy as np


class R:
    img = np.zeros((4, 4, 3), np.float32)


class It:
    def __init__(self, count, width, height):
        self.size = width, height
        self.x0, self.q0, self.l0 = (np.zeros((count, k), np.float32) for k in (3, 4, 3))
        self.lo, self.col = np.zeros(count, np.float32), np.zeros((count, 3), np.float32)
        self.gI, self.R = np.zeros((width, height, 3), np.float32), R()
        self.calls, self.rates = [], []

    def opt(self, a=1, b=1):
        self.rates.append((a, b))

    def step(self, target, time):
        self.calls.append("step")
        self.opt()

    def __getattr__(self, name):
        if name in ("hexf", "mlpf", "projf", "rastf", "rastb", "projb"):
            return lambda *_: self.calls.append(name)
        raise AttributeError(name)


made = []
plain = It


def It(*arguments):
    made.append(plain(*arguments))
    return made[-1]
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("RC", "1")
    (tmp_path / "iter.py").write_text(ITER, encoding="utf-8")
    before = sys.modules.pop("iter", None)
    yield tmp_path
    sys.modules.pop("iter", None)
    if before is not None:
        sys.modules["iter"] = before


def test_it_draws_our_splats(folder: Path) -> None:
    module = yardstick.load_yardstick(folder)
    assert str(folder) not in sys.path
    yardstick.drawing(module, 8, 20)()
    state, splats = module.made[0], cloud(20)
    assert state.size == (8, 8)
    np.testing.assert_array_equal(state.x0, splats.means.numpy())
    np.testing.assert_array_equal(state.lo, splats.logit_opacities.numpy())
    assert state.calls == ["hexf", "mlpf", "projf", "rastf", "projf", "rastf", "rastb", "projb"]
    assert np.abs(state.gI).min() > 0


def test_its_training_step_has_rate_0_too(folder: Path) -> None:
    module = yardstick.load_yardstick(folder)
    yardstick.training_step(module, 4, 20)()
    state = module.made[0]
    assert state.calls[-1] == "step"
    assert state.rates == [(0, 0)]


def test_a_folder_without_a_yardstick_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"holds no yardstick \(no iter.py\)"):
        yardstick.load_yardstick(tmp_path)


def test_a_yardstick_that_lacks_a_package_is_refused(folder: Path) -> None:
    (folder / "iter.py").write_text("import nothing_of_this_name", encoding="utf-8")
    with pytest.raises(DataError, match="cannot be imported: No module named 'nothing_of"):
        yardstick.load_yardstick(folder)
    assert str(folder) not in sys.path
