"""gsdmsr eval on a trained run, held to other libraries that see nothing but picture files."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import multiscale_structural_similarity_index_measure

from gsdmsr_cli import cli
from gsdmsr_cli.evaluation import speed
from gsdmsr_cli.evaluation.lpips import Lpips, load_lpips
from gsdmsr_cli.imaging import read_image
from gsdmsr_cli.synthetic import write_scene

SIDE = 176
"""Of the pictures: the least for MS-SSIM."""

Eval = Callable[..., dict[str, Any]]


def gsdmsr(*arguments: object) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["gsdmsr", *map(str, arguments)])
        patch.setattr(speed, "SECONDS", 0.05)
        with pytest.raises(SystemExit) as ended:
            cli.main()
    assert isinstance(ended.value.code, int)
    return ended.value.code


@pytest.fixture(scope="module", autouse=True)
def threads_as_before() -> Iterator[None]:
    """Training says how many threads numba and torch use."""
    before = numba.get_num_threads(), torch.get_num_threads()
    yield
    numba.set_num_threads(before[0])
    torch.set_num_threads(before[1])


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("eval") / "scene"
    write_scene(folder, size=SIDE, train=8, val=1, test=3)
    return folder


@pytest.fixture(scope="module")
def run(data: Path) -> Path:
    folder = data.parent / "run"
    options = "--set=splats.count=400", "--set=density.cap=600", "--steps=60"
    assert gsdmsr("train", "--data", data, "--out", folder, "--preset=dnerf", *options) == 0
    return folder


@pytest.fixture
def evaluate(run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> Eval:
    monkeypatch.delenv("GSDMSR_LPIPS_DIR", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(run / "no weights"))

    def call(*options: object) -> dict[str, Any]:
        capsys.readouterr()
        assert gsdmsr("eval", run, "--json", *options) == 0
        return dict(json.loads(capsys.readouterr().out))

    return call


def test_figures_equal_those_of_other_libraries(
    run: Path, data: Path, evaluate: Eval, tmp_path: Path
) -> None:
    document = evaluate("--background", "both")
    assert gsdmsr("render", run, "--path", "test", "--video", "none", "--out", tmp_path) == 0
    assert document["protocol"]["background"] == "white"
    for i, frame in enumerate(document["frames"]):
        drawn = read_image(tmp_path / "test" / f"{i:04d}.png") / 255
        true = true_picture(data / "test" / f"{frame['name']}.png")
        assert frame["psnr"] == pytest.approx(peak_signal_noise_ratio(true, drawn), abs=1e-4)
        assert frame["ssim"] == pytest.approx(zero_padded_ssim(true, drawn), abs=1e-4)
        batches = (torch.from_numpy(p).permute(2, 0, 1)[None] for p in (drawn, true))
        expected = multiscale_structural_similarity_index_measure(*batches, data_range=1.0)
        assert frame["ms_ssim"] == pytest.approx(expected.item(), abs=1e-4)
    for metric in ("psnr", "ssim"):
        mean = np.mean([frame[metric] for frame in document["frames"]])
        assert document["aggregate"][metric] == pytest.approx(mean)
    assert 0.3 < document["aggregate"]["ms_ssim"]["value"] < 1


def true_picture(path: Path) -> np.ndarray:
    """Return the picture on white as a file of 8 bits holds it, (H, W, 3) in [0, 1]."""
    rgba = read_image(path) / 255
    alpha = rgba[..., 3:]
    return np.rint(255 * (rgba[..., :3] * alpha + 1 - alpha)) / 255


def zero_padded_ssim(true: np.ndarray, drawn: np.ndarray) -> float:
    """Return scikit-image's SSIM with zeros, not mirrored pixels, around the pictures."""
    margin = 12
    padded = (np.pad(p, ((margin, margin), (margin, margin), (0, 0))) for p in (true, drawn))
    _, full = structural_similarity(
        *padded, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        data_range=1.0, channel_axis=2, full=True,
    )  # fmt: skip
    return float(full[margin:-margin, margin:-margin].mean())


def test_the_other_background_is_scored_as_if_it_were_asked_for(evaluate: Eval) -> None:
    both, black = evaluate("--background", "both"), evaluate("--background", "black")
    assert black["protocol"]["background"] == "black" and black["backgrounds"] == {}
    assert list(both["backgrounds"]) == ["black"]
    elsewhere = both["backgrounds"]["black"]
    for key in ("aggregate", "parts", "frames"):
        assert elsewhere[key] == black[key] != both[key] or key == "parts"
    white = evaluate()
    assert (white["aggregate"], white["frames"]) == (both["aggregate"], both["frames"])


def test_the_time_of_training_is_that_of_its_stages(evaluate: Eval) -> None:
    training = evaluate()["training"]
    stages = training["stages_s"]
    assert set(stages) == {"look", "learn", "grow", "watch", "save", "other"}
    assert sum(stages.values()) == pytest.approx(training["train_s"], abs=0.02)
    assert stages["look"] > stages["learn"] > 0


def test_a_run_whose_log_knows_no_stages_has_none(run: Path, evaluate: Eval) -> None:
    log = run / "metrics.jsonl"
    before = log.read_text()
    entries = [json.loads(line) for line in before.splitlines()]
    try:
        log.write_text("".join(f"{json.dumps(e | {'stages': {}})}\n" for e in entries))
        assert evaluate()["training"]["stages_s"] == {}
    finally:
        log.write_text(before)


def test_lpips_on_both_ranges_with_real_weights(
    shared_data: Path, run: Path, data: Path, evaluate: Eval, tmp_path: Path
) -> None:
    weights = shared_data / "lpips"
    assert "lpips_alex_inria" not in evaluate()["aggregate"]
    aggregate = evaluate("--lpips-inria", "--lpips-weights", weights)["aggregate"]
    assert gsdmsr("render", run, "--path", "test", "--video", "none", "--out", tmp_path) == 0
    net = load_lpips("alex", weights)
    assert isinstance(net, Lpips)
    pairs = [
        (read_image(path) / 255, true_picture(data / "test" / f"r_{i:03d}.png"))
        for i, path in enumerate(sorted((tmp_path / "test").iterdir()))
    ]
    for name, low in (("lpips_alex", -1.0), ("lpips_alex_inria", 0.0)):
        batches = (np.stack(pictures) * (1 - low) + low for pictures in zip(*pairs, strict=True))
        tensors = (torch.from_numpy(b).permute(0, 3, 1, 2).float() for b in batches)
        mean = net.distance(*tensors).mean().item()
        assert aggregate[name]["value"] == pytest.approx(mean, abs=1e-5)
    assert aggregate["lpips_vgg_inria"]["value"] is None
    assert "vgg.backbone.pth" in aggregate["lpips_vgg_inria"]["reason"]
