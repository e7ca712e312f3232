"""What a training is expected to take, against what one takes; and who is warned."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
from datasets import noise, write_dnerf, write_picture

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.training.memory import Estimate, estimate, warning

MEASURED = """
import json, resource, sys
from pathlib import Path
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.raster import best_engine
from gsdmsr_cli.scene.pictures import HalvedPictures, Pictures
from gsdmsr_cli.training.memory import estimate
from gsdmsr_cli.training.trainer import Trainer
from gsdmsr_cli.training.warm_up import warm_up, warm_up_motion

def held():
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()

scene, options = read_scene(Path(sys.argv[1])), sys.argv[2:]
preset, engine = load_preset("dnerf", None, options), best_engine("cpu")
views = scene.split("train")
warm_up(scene, preset, engine)
warm_up_motion(scene, preset, engine)

def read(views, pictures):
    pictures.preload(views)
    halved = HalvedPictures(pictures)
    for view in views:
        halved.load(view)

# what decoding itself takes: libraries, and buffers that drawing will use again
read(views[:10], Pictures((1.0, 1.0, 1.0), 1, 8 << 20))
begun, pictures = held(), Pictures((1.0, 1.0, 1.0), 1, preset.data.cache_mib << 20)
read(views, pictures)
kept = held()
trainer = Trainer(scene, preset, engine, pictures)
for _ in range(3):
    trainer.step()
expected = estimate(views, preset, 1)
print(json.dumps({
    "pictures": [kept - begun, expected.pictures],
    "splats and drawing": [held() - kept, expected.splats + expected.drawing],
}))
"""
"""What a training holds, and what it is expected to, in a process that has done nothing else."""


@pytest.mark.skipif(sys.platform != "linux", reason="reads what Linux tells of a process")
def test_a_training_takes_what_it_is_expected_to(tmp_path: Path) -> None:
    scene = write_dnerf(tmp_path / "scene", train=100, val=1, test=1)
    for path in scene.rglob("*.png"):
        write_picture(path, noise(400, 400))
    options = ["splats.count=400000", "density.cap=400000", "splats.start=box",
               "training.views_per_step=1", "training.steps=1000"]  # fmt: skip
    done = subprocess.run([sys.executable, "-c", MEASURED, str(scene), *options],
                          capture_output=True, text=True, check=False)  # fmt: skip
    assert done.returncode == 0, done.stderr
    for part, (found, expected) in json.loads(done.stdout).items():
        assert expected == pytest.approx(found, rel=0.3), (part, found, expected)


def test_every_part_grows_with_what_it_is_of(tiny_scene: Path) -> None:
    views, preset = read_scene(tiny_scene).split("train"), load_preset("dnerf", None, [])
    one, two = estimate(views, preset, 1), estimate(views, preset, 2)
    assert one.processes == 0 and two.processes > 45 << 20
    assert two.drawing == 2 * one.drawing and two.splats == one.splats
    density = replace(preset.density, cap=2 * preset.density.cap)
    assert estimate(views, replace(preset, density=density), 1).splats == 2 * one.splats
    none = replace(preset, data=replace(preset.data, cache_mib=0))
    assert estimate(views, none, 1).pictures == 0
    assert estimate(views * 2, preset, 1).pictures == 2 * one.pictures


def test_a_warning_says_what_is_short_and_what_to_lower() -> None:
    expected = Estimate(300 << 20, 200 << 20, 0, 10 << 20)
    assert warning(expected, 510 << 20) is None and warning(expected, None) is None
    assert warning(expected, (510 << 20) - 1) == (
        "this training may take 510 MiB (pictures 300, splats 200, drawing 10), and 510 MiB are "
        "available; lower data.cache_mib, density.cap or training.views_per_step, or raise "
        "data.downscale"
    )


def test_a_training_warns_before_it_starts(
    tiny_scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from gsdmsr_cli.commands import _preparing
    from gsdmsr_cli.commands._party import Party
    from gsdmsr_cli.ground import limits

    options = ["splats.count=20", "splats.start=box", "training.threads=1"]
    given = read_scene(tiny_scene), load_preset("dnerf", None, options), Party(), "cpu"
    monkeypatch.setattr(limits, "available_memory", lambda: 1 << 50)
    _preparing.prepare(*given)
    assert "available" not in capsys.readouterr().err
    monkeypatch.setattr(limits, "available_memory", lambda: 1 << 20)
    _preparing.prepare(*given)
    said = capsys.readouterr().err
    assert "warning: this training may take" in said and "and 1 MiB are available" in said
