"""A library that stands in for the NVIDIA driver, on a machine with two cards."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from gsdmsr_cli.backends.cuda import driver, launch

HERE = Path(__file__).parent
STREAM = 4_000_000_000_000


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    if shutil.which("gcc") is None:
        pytest.skip("there is no gcc to build a stand-in for the driver with")
    path = tmp_path_factory.mktemp("driver") / "libcuda.so"
    subprocess.run(
        ["gcc", "-shared", "-fPIC", "-o", str(path), str(HERE / "fake_driver.c")], check=True
    )
    return path


@pytest.fixture
def fake(library: Path, monkeypatch: pytest.MonkeyPatch) -> ctypes.CDLL:
    """The stand-in, on a machine with two cards of which the second is used."""
    fake = ctypes.CDLL(str(library))
    fake.take_log.restype = ctypes.c_char_p
    fake.take_log(), fake.fail_with(0)
    monkeypatch.setattr(driver, "_LIBRARY", str(library))
    monkeypatch.setattr(driver, "load_nvrtc", lambda major: SimpleNamespace(version=(13, 0)))
    monkeypatch.setattr(driver, "compiled", lambda nvrtc, source, capability: b"\x7fELF\0rest")
    monkeypatch.setattr(torch.cuda, "init", lambda: None)
    monkeypatch.setattr(torch.cuda, "get_device_capability", lambda index: (9, index - 1))
    monkeypatch.setattr(torch._C, "_cuda_getCurrentRawStream", lambda index: STREAM, raising=False)
    monkeypatch.setitem(launch.runners, "cuda", driver.Driver())
    return fake
