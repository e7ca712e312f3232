"""gsdmsr eval on a trained run, held to other libraries that see nothing but picture files."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from datasets import write_picture
from sinks import SINKS, sink
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torchmetrics.functional.image import multiscale_structural_similarity_index_measure

from gsdmsr_cli.cli.main import main
from gsdmsr_cli.commands import _trained
from gsdmsr_cli.commands import eval as evaluation
from gsdmsr_cli.demo.synthetic import write_scene
from gsdmsr_cli.evaluation import speed
from gsdmsr_cli.evaluation.lpips import Lpips, load_lpips
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.reporting.markup import at
from gsdmsr_cli.runs import seen_pictures
from gsdmsr_cli.scene.imaging import read_image
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training.timings import TIMINGS

SIDE = 176
"""Of the pictures: the least for MS-SSIM."""

Eval = Callable[..., dict[str, Any]]

Refuse = Callable[..., str]


def gsdmsr(*arguments: object) -> int:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["gsdmsr", *map(str, arguments)])
        patch.setattr(speed, "SECONDS", 0.05)
        with pytest.raises(SystemExit) as ended:
            main()
    assert isinstance(ended.value.code, int)
    return ended.value.code


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


@pytest.fixture
def refuse(run: Path, capsys: pytest.CaptureFixture[str], monkeypatch: Any) -> Refuse:
    """Evaluates, expects an exit code and one line on stderr, and returns that line."""
    monkeypatch.setenv("TORCH_HOME", str(run / "no weights"))
    monkeypatch.delenv("GSDMSR_DEBUG", raising=False)

    def call(code: int, *options: object, folder: Path = run) -> str:
        capsys.readouterr()
        assert gsdmsr("eval", folder, *options) == code
        err = capsys.readouterr().err
        assert err.startswith("error: ") and err.count("\n") == 1
        return err

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


def test_the_time_of_training_is_that_of_its_timings(evaluate: Eval) -> None:
    training = evaluate()["training"]
    seconds = training["stages_s"]
    assert set(seconds) == {*TIMINGS, "other"}
    assert sum(seconds.values()) == pytest.approx(training["train_s"], abs=0.02)
    assert seconds["gradients"] > seconds["optimizer"] > 0


def test_a_run_whose_log_has_no_timings_has_none(run: Path, evaluate: Eval) -> None:
    log = run / "metrics.jsonl"
    before = log.read_text()
    entries = [json.loads(line) for line in before.splitlines()]
    try:
        log.write_text("".join(f"{json.dumps(e | {'timings': {}})}\n" for e in entries))
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


def test_gates_are_told_everywhere(
    run: Path, refuse: Refuse, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = tmp_path / "summary.md"
    told.write_text("before\n")
    monkeypatch.setenv("GITHUB_STEP_SUMMARY", str(told))
    gates = "--fail-under", "psnr=1", "--fail-under", "ssim=0.9999", "--fail-over", "lpips_vgg=1"
    error = refuse(4, *gates, "--junit", tmp_path / "j.xml", "--github-summary")
    assert "ssim is " in error and "lpips_vgg has no value" in error and "psnr is" not in error
    suite = ElementTree.parse(tmp_path / "j.xml").getroot()
    assert (suite.get("tests"), suite.get("failures")) == ("3", "2")
    text = told.read_text()
    assert text.startswith("before\n## gsdmsr eval run\n") and text.count("**failed**") == 2


@pytest.mark.parametrize("lost", SINKS)
def test_every_file_is_written_though_nobody_gets_what_is_printed(
    run: Path, tmp_path: Path, lost: str
) -> None:
    wishes = "--json", "--report", "--fail-under", "psnr=99", "--out", str(tmp_path / "eval")
    files = "--junit", str(tmp_path / "j.xml"), "--github-summary"
    command = [sys.executable, "-m", "gsdmsr_cli", "eval", str(run), *wishes, *files]
    told = os.environ | {"GITHUB_STEP_SUMMARY": str(tmp_path / "summary.md")}
    with sink(lost) as out:
        ended = subprocess.run(command, stdout=out, stderr=subprocess.PIPE, env=told, check=False)
    assert ended.returncode == 4 and ended.stderr.count(b"\n") == 1
    assert ended.stderr.startswith(b"error: psnr is ")
    assert {path.name for path in (tmp_path / "eval").iterdir()} == {
        "metrics.json", "report.html", "report.md",
    }  # fmt: skip
    assert ElementTree.parse(tmp_path / "j.xml").getroot().get("failures") == "1"
    assert "**failed**" in (tmp_path / "summary.md").read_text()


def test_a_run_is_as_good_as_itself_and_not_as_good_as_a_better_one(
    run: Path, evaluate: Eval, refuse: Refuse, tmp_path: Path
) -> None:
    document = evaluate("--out", tmp_path / "there")
    path = tmp_path / "there" / "metrics.json"
    assert json.loads(path.read_text()) == document
    evaluate("--baseline", path)
    document["aggregate"]["psnr"] += 1
    better = tmp_path / "better.json"
    better.write_text(json.dumps(document))
    assert "wanted at most 0 worse" in refuse(4, "--baseline", better)
    evaluate("--baseline", better, "--tolerance", "psnr=1.01")
    error = refuse(3, "--baseline", better, "--downscale", 2)
    assert "its resolution is 176 x 176, not 88 x 88 as here" in error
    error = refuse(3, "--baseline", better, "--background", "black")
    assert "its background is 'white', not 'black' as here" in error


def test_wishes_that_cannot_be_met_are_refused_before_the_work(
    run: Path, refuse: Refuse, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("GITHUB_STEP_SUMMARY", raising=False)
    monkeypatch.setattr(evaluation, "measure", lambda *_: pytest.fail("it measures"))
    (tmp_path / "file").touch()
    assert "not a report" in refuse(3, "--baseline", run / "run.json")
    assert "cannot be read" in refuse(3, "--baseline", tmp_path / "absent.json")
    assert "GITHUB_STEP_SUMMARY is not set" in refuse(2, "--github-summary")
    assert "--junit has nothing to tell" in refuse(2, "--junit", tmp_path / "j.xml")
    assert "no such metric" in refuse(2, "--fail-over", "fid=3")
    assert "use --fail-over" in refuse(2, "--fail-under", "lpips_alex=0.1")
    assert "file/eval: cannot be made" in refuse(3, "--out", tmp_path / "file" / "eval")
    gate = "--fail-under", "psnr=1"
    assert "file: cannot be made" in refuse(3, *gate, "--junit", tmp_path / "file" / "j.xml")


def test_parts_that_masks_choose_are_scored_where_they_are(
    evaluate: Eval, refuse: Refuse, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In all frames but the first, the left half moves; a third of all pixels counts."""
    moves = np.zeros((SIDE, SIDE, 1), np.uint8)
    write_picture(tmp_path / "still.png", moves)
    moves[:, : SIDE // 2] = 255
    write_picture(tmp_path / "moves.png", moves)
    counts = np.zeros((SIDE, SIDE, 1), np.uint8)
    counts[: SIDE // 3] = 255
    write_picture(tmp_path / "counts.png", counts)

    def read(folder: Path) -> Scene:
        scene = read_scene(folder)
        views = [
            replace(
                view,
                signals={
                    "mask": tmp_path / "counts.png",
                    "moving": tmp_path / ("still.png" if view.name == "r_000" else "moves.png"),
                },
            )
            for view in scene.views
        ]
        return replace(scene, views=tuple(views))

    plain = evaluate()
    assert plain["parts"] == {} and plain["consecutive"] == {"pairs": 0, "pixels": 0}
    assert "0 of 3 views have a neighbour" in plain["aggregate"]["flicker"]["reason"]
    monkeypatch.setattr(_trained, "read_scene", read)
    monkeypatch.setattr(seen_pictures, "check", lambda *_: None)  # the masks are new
    document = evaluate("--fail-under", "psnr_moving=1")
    assert {part: entry["frames"] for part, entry in document["parts"].items()} == {
        "masked": 3, "moving": 2, "static": 3,
    }  # fmt: skip
    assert document["aggregate"]["psnr"] == plain["aggregate"]["psnr"]
    first, *others = document["frames"]
    assert "psnr_moving" not in first and first["psnr_static"] == first["psnr_masked"]
    for frame in others:
        errors = [10 ** (-frame[f"psnr_{part}"] / 10) for part in ("moving", "static", "masked")]
        assert errors[2] == pytest.approx((errors[0] + errors[1]) / 2)
    mean = np.mean([frame["psnr_moving"] for frame in others])
    assert document["aggregate"]["psnr_moving"] == pytest.approx(mean)
    monkeypatch.undo()
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    assert "psnr_moving has no value" in refuse(4, "--fail-under", "psnr_moving=1")


def test_a_page_that_plays_the_run_lies_beside_the_report_if_asked(
    evaluate: Eval, tmp_path: Path
) -> None:
    link = '<a href="play.html">'
    evaluate("--report", "--out", tmp_path / "a")
    assert not (tmp_path / "a" / "play.html").exists()
    assert link not in (tmp_path / "a" / "report.html").read_text(encoding="utf-8")
    evaluate("--report", "--play", "--out", tmp_path / "b")
    assert link in (tmp_path / "b" / "report.html").read_text(encoding="utf-8")
    assert "<canvas" in (tmp_path / "b" / "play.html").read_text(encoding="utf-8")


def test_the_report_shows_the_run_in_one_file(
    run: Path, evaluate: Eval, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    document = evaluate("--background", "both", "--report", "--out", tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {
        "metrics.json", "report.html", "report.md",
    }  # fmt: skip
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert len(page) < 5_000_000
    for name in (frame["name"] for frame in document["frames"]):
        assert f"ground truth of {name}" in page  # all three are among the worst or the best
    figures = re.findall(r'<data value="([^"]+)" data-of="([^"]+)">', page)
    assert len(figures) > 40
    for value, path in figures:
        assert float(value) == at(document, path), path
    assert page.count("<svg") == 3 and "drawing and gradients" in page
    assert f"{document['aggregate']['psnr']:.4f}" in (tmp_path / "report.md").read_text()
