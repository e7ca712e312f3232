"""The format compact is a run that is evaluated as any other, at a fraction of the bytes."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file, save_file

from gsdmsr_cli.cli.main import main
from gsdmsr_cli.evaluation import speed

QUICK = (
    "splats.count=300", "training.static_until=0.1", "density.start=10", "density.every=10",
    "training.threads=1",
)  # fmt: skip

Gsdmsr = Callable[..., tuple[int, Any]]


@pytest.fixture
def gsdmsr(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Gsdmsr:
    """Runs a command line; returns its exit code and what it has printed as JSON."""
    monkeypatch.setattr(speed, "SECONDS", 0.05)

    def call(*words: object) -> tuple[int, Any]:
        monkeypatch.setattr(sys, "argv", ["gsdmsr", *map(str, words), "--json"])
        with pytest.raises(SystemExit) as ended:
            main()
        printed = capsys.readouterr().out
        return int(str(ended.value.code)), json.loads(printed.splitlines()[-1])

    return call


def test_it_is_evaluated_as_any_run_at_a_fraction_of_the_bytes(
    gsdmsr: Gsdmsr, tiny_scene: Path, tmp_path: Path
) -> None:
    run, packed = tmp_path / "run", tmp_path / "packed"
    threads = torch.get_num_threads()
    options = [word for option in QUICK for word in ("--set", option)]
    training = "train", "--data", tiny_scene, "--out", run, "--preset", "compact", "--steps", 60
    code, _ = gsdmsr(*training, *options)
    assert code == 0
    code, wrote = gsdmsr("export", run, "--format", "compact", "--out", packed)
    assert code == 0 and wrote["files"] == [str(packed / "checkpoint.safetensors")]
    before, after = (gsdmsr("eval", folder)[1] for folder in (run, packed))
    torch.set_num_threads(threads)
    assert abs(before["aggregate"]["psnr"] - after["aggregate"]["psnr"]) < 0.3
    assert before["protocol"]["checkpoint_step"] == after["protocol"]["checkpoint_step"] == 60
    sizes = [
        document["storage"]["splats_bytes"] + document["storage"]["motion_bytes"]
        for document in (before, after)
    ]
    stored = sum(t.nbytes for t in load_file(packed / "checkpoint.safetensors").values())
    assert sizes[1] == stored < 0.3 * sizes[0]
    assert after["storage"]["training_state_bytes"] == 0
    assert after["storage"]["checkpoint_bytes"] - stored < 20_000

    code, told = gsdmsr("train", "--data", tiny_scene, "--out", packed, "--resume")
    assert code == 3 and "which cannot be trained further" in told["error"]["message"]
    code, told = gsdmsr("export", run, "--format", "compact", "--out", packed)
    assert code == 3 and "choose another --out" in told["error"]["message"]
    save_file({}, packed / "checkpoint.safetensors", metadata={"gsdmsr": "{}"})
    code, told = gsdmsr("eval", packed)
    assert code == 3 and "damaged checkpoint" in told["error"]["message"]
