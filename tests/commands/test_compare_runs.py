"""gsdmsr compare: figures side by side, what is not comparable marked, and pictures."""

from __future__ import annotations

import copy
import json
import re
from pathlib import Path
from typing import Any

import pytest
from datasets import write_json
from reports import small_report
from training_checks import begun_run

from gsdmsr_cli.commands import compare
from gsdmsr_cli.commands import eval as evaluate
from gsdmsr_cli.evaluation import speed
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError, UsageError

Capture = pytest.CaptureFixture[str]


def report(path: Path, psnr: float = 26.0, **protocol: Any) -> Path:
    document = copy.deepcopy(small_report())
    document["aggregate"]["psnr"] = psnr
    document["protocol"] |= protocol
    write_json(path, document)
    return path


def test_figures_stand_side_by_side_and_the_best_has_a_star(
    tmp_path: Path, capsys: Capture
) -> None:
    one = report(tmp_path / "one" / "eval" / "metrics.json", 25.0, preset="video")
    other = report(tmp_path / "two" / "eval" / "metrics.json", 27.5)
    compare.run([one, other], None, None)
    lines = capsys.readouterr().out.splitlines()
    assert any(re.search(r"│ psnr +│ 25.0000 +│ 27.5000 \*", line) for line in lines)
    assert any(re.search(r"│ preset +│ video +│ dnerf", line) for line in lines)
    assert any(re.search(r"┃ +┃ one +┃ two ", line) for line in lines)
    assert not any("lpips" in line for line in lines)  # nobody has a value
    with say.on_its_own(as_json=True):
        compare.run([one, other.parent.parent], None, None)  # a run folder says the same
    runs = json.loads(capsys.readouterr().out)["runs"]
    assert [run["name"] for run in runs] == ["one", "two"]
    assert [run["metrics"]["psnr"] for run in runs] == [25.0, 27.5]
    assert runs[0]["metrics"]["ms_ssim"] == 0.95 and runs[0]["metrics"]["lpips_alex"] is None
    assert [run["comparable"] for run in runs] == [True, True]
    assert (runs[0]["splats"], runs[0]["fps"], runs[0]["model_bytes"]) == (1234, 100.0, 1_500_000)


def test_what_was_measured_otherwise_is_marked(tmp_path: Path, capsys: Capture) -> None:
    one = report(tmp_path / "a.json", 25.0)
    other = report(tmp_path / "b.json", 30.0, split="val", resolution=[100, 80])
    third = report(tmp_path / "c.json", 26.0)
    with say.on_its_own(as_json=True):
        compare.run([one, other, third], None, None)
    out, err = capsys.readouterr()
    runs = json.loads(out)["runs"]
    assert [run["comparable"] for run in runs] == [True, False, True]
    assert runs[1]["differs"] == ["split", "resolution"]
    assert err == "warning: b.json was measured otherwise than a.json: split, resolution\n"
    compare.run([one, other, third], None, None)
    out = capsys.readouterr().out
    assert re.search(r"25.0000 +│ 30.0000 +│ 26.0000 \*", out) and "other protocol" in out


@pytest.fixture(scope="module")
def runs(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two evaluated runs that have just begun."""
    folders = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(speed, "SECONDS", 0.05)
        patch.delenv("GSDMSR_LPIPS_DIR", raising=False)
        patch.setenv("TORCH_HOME", str(tmp_path_factory.mktemp("torch")))
        for count in (40, 400):
            options = [f"splats.count={count}", "training.threads=1"]
            folder = tmp_path_factory.mktemp("runs") / f"<{count}>"
            begun_run(tiny_scene, folder, options, preset="static")
            evaluate.run(folder)
            folders.append(folder)
    return folders


def test_the_page_shows_the_same_views_of_every_run(
    runs: list[Path], tmp_path: Path, capsys: Capture
) -> None:
    capsys.readouterr()
    out = tmp_path / "pages" / "compare.html"
    compare.run(runs, out, None)
    assert f"written to {out}" in capsys.readouterr().out
    text = out.read_text(encoding="utf-8")
    assert "script-src 'none'" in text and "<script" not in text
    assert not re.search(r'(?:src|href)="(?!data:)', text)
    assert text.count("<h2>") == 4 and text.count('src="data:image/webp;base64,') == 4 * 3
    assert "&lt;40&gt;, PSNR" in text and "<40>" not in text
    captions = re.findall(r"<figcaption>(.*?)</figcaption>", text)
    assert captions[:3:3] == ["true picture"]
    pictures = re.findall(r'src="(data:[^"]+)"', text)
    assert len(set(pictures)) == len(pictures)  # what 40 splats show is not what 400 show


def test_a_run_that_has_gone_on_since_must_be_evaluated_again(
    runs: list[Path], tmp_path: Path
) -> None:
    path = runs[1] / "eval" / "metrics.json"
    document = json.loads(path.read_text())
    document["protocol"]["checkpoint_step"] = 77
    before = path.read_text()
    write_json(path, document)
    try:
        with pytest.raises(DataError, match=r"evaluated at step 77 and is at step 0 now"):
            compare.run(runs, tmp_path / "a.html", None)
    finally:
        path.write_text(before)


@pytest.mark.parametrize(
    ("names", "kind", "message"),
    [
        (["a.json"], UsageError, "two runs or more"),
        (["a.json", "a.json"], UsageError, "same run twice"),
        (["a.json", "folder"], DataError, "has not been evaluated; run gsdmsr eval"),
        (["a.json", "missing"], DataError, "has not been evaluated"),
        (["a.json", "b.json"], DataError, "not a report of eval"),
    ],
)
def test_what_cannot_be_compared_is_refused(
    tmp_path: Path, names: list[str], kind: type[Exception], message: str
) -> None:
    report(tmp_path / "a.json")
    (tmp_path / "b.json").write_text("{}")
    (tmp_path / "folder").mkdir()
    with pytest.raises(kind, match=message):
        compare.run([tmp_path / name for name in names], None, None)
