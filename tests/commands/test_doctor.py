"""gsdmsr doctor: the report tells the truth about engines, weights and presets."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from gsdmsr_cli import raster
from gsdmsr_cli.backends.cuda import availability
from gsdmsr_cli.commands import doctor
from gsdmsr_cli.ground import say


@pytest.fixture(autouse=True)
def _no_weights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Hide the weights that this machine may have."""
    monkeypatch.delenv("GSDMSR_LPIPS_DIR", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "hub"))


def test_json_is_one_object_on_stdout(capsys: pytest.CaptureFixture[str]) -> None:
    with say.on_its_own(as_json=True):
        doctor.run()
    captured = capsys.readouterr()
    report = json.loads(captured.out)
    assert captured.err == ""
    assert report["python"].split(".")[:2] == [str(part) for part in sys.version_info[:2]]
    assert report["packages"]["torch"] == torch.__version__
    assert report["cpu"]["cores"] >= 1
    assert {"default", "dnerf", "hexplane", "static"} <= set(report["presets"])
    assert {"dnerf"} <= set(report["plugins"]["formats"])


def test_every_engine_says_what_it_says_itself() -> None:
    report = doctor.examine()["engines"]
    assert list(report) == raster.engine_names()
    for name, devices in report.items():
        for device, reason in devices.items():
            assert reason == raster.load_engine(name).unavailable(device)
    assert report["reference"]["cpu"] is None
    if not torch.cuda.is_available():
        assert all(devices["cuda"] for devices in report.values())


def test_an_engine_that_cannot_be_imported_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(name: str) -> raster.Engine:
        raise ImportError(f"no library for {name}")

    monkeypatch.setattr(raster, "load_engine", fail)
    for name, devices in doctor.examine()["engines"].items():
        assert set(devices.values()) == {f"cannot be imported: no library for {name}"}


def test_missing_weights_have_a_reason() -> None:
    for net, reason in doctor.examine()["lpips"].items():
        assert reason is not None
        assert net in reason


def test_weights_are_found(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GSDMSR_LPIPS_DIR", str(shared_data / "lpips"))
    found = doctor.examine()["lpips"]
    assert found["alex"] is None
    assert found["squeeze"] is None
    assert found["vgg"] is not None


def test_damaged_weights_are_told_and_the_report_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "alex.backbone.pth").write_bytes(b"no weights")
    (tmp_path / "alex.pth").write_bytes(b"no weights")
    monkeypatch.setenv("GSDMSR_LPIPS_DIR", str(tmp_path))
    found = doctor.examine()["lpips"]
    assert "alex.pth" in found["alex"] or "alex.backbone.pth" in found["alex"]
    assert found["squeeze"] is not None


def test_the_table_shows_reasons_as_they_are_written(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(doctor, "_engine", lambda _: {"cpu": None, "cuda": "not [bold] here"})
    monkeypatch.setenv("COLUMNS", "200")
    doctor.run()
    out = capsys.readouterr().out
    assert "engine reference on cuda" in out
    assert "no: not [bold] here" in out


def test_the_gpu_is_described_or_what_is_missing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = doctor.examine()["gpu"]
    assert found["missing"] == availability.missing()
    assert (found["name"] is None) == (not torch.cuda.is_available())
    card = SimpleNamespace(name="Some [Card]", total_memory=80 << 30, major=9, minor=0)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda _: card)
    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(availability, "missing", lambda: None)
    monkeypatch.setattr(availability, "load_nvrtc", lambda _: SimpleNamespace(version=(13, 0)))
    monkeypatch.setattr(doctor, "_engine", lambda _: {"cpu": None, "cuda": None})
    monkeypatch.setenv("COLUMNS", "200")
    assert doctor.examine()["gpu"] == {
        "cuda": "13.0", "nvrtc": "13.0", "name": "Some [Card]", "memory_mib": 81920,
        "capability": "9.0", "missing": None,
    }  # fmt: skip
    doctor.run()
    said = "Some [Card], 81920 MiB, compute capability 9.0; torch for CUDA 13.0, NVRTC 13.0"
    assert said in capsys.readouterr().out
