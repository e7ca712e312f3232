"""What each command is called with, for the options on its line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gsdmsr_cli.benchmark.trials import Terms
from gsdmsr_cli.evaluation.request import Demands, Output
from gsdmsr_cli.evaluation.request import Request as Evaluation
from gsdmsr_cli.exports import format_names
from gsdmsr_cli.filming.request import Request
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.training.request import Request as Training

Gsdmsr = Any  # the fixture of conftest.py


@pytest.mark.parametrize(
    ("line", "name", "arguments"),
    [
        (
            "train --data d --out r",
            "train",
            (Training(Path("d"), Path("r")),),
        ),
        (
            "train --data d --out r --preset dnerf --config f.yaml --set a.b=1 --set a.c=2"
            " --device cpu --resume --verify-data --tensorboard --wandb p --view --port 80",
            "train",
            (
                Training(
                    Path("d"),
                    Path("r"),
                    "dnerf",
                    Path("f.yaml"),
                    ("a.b=1", "a.c=2"),
                    "cpu",
                    resume=True,
                    verify=True,
                    tensorboard=True,
                    wandb="p",
                    view_port=80,
                ),
            ),
        ),
        ("train --data d --out r --view", "train", (Training(Path("d"), Path("r"), view_port=0),)),
        ("view r", "view", (Path("r"), "127.0.0.1", 0, None, False)),
        ("view r --port 9 --host h --data d --open", "view", (Path("r"), "h", 9, Path("d"), True)),
        ("eval r", "eval", (Path("r"), Evaluation(), Demands(), Output(), None)),
        (
            "eval r --split val --background both --downscale 2 --lpips-weights w --lpips-inria"
            " --json --fail-under psnr=25 --fail-under ssim=0.9 --fail-over lpips_alex=0.1"
            " --baseline b.json --tolerance psnr=0.5 --junit j.xml --github-summary --out o"
            " --report --play --data d --verify-data",
            "eval",
            (
                Path("r"),
                Evaluation("val", "both", 2, Path("w"), True, True),
                Demands(
                    ("psnr=25", "ssim=0.9"), ("lpips_alex=0.1",), Path("b.json"), ("psnr=0.5",)
                ),
                Output(Path("o"), Path("j.xml"), True, True, True),
                Path("d"),
            ),
        ),
        ("render r", "render", (Path("r"), Request(), None, None)),
        (
            "render r --path orbit --frames 9 --out o --data d",
            "render",
            (Path("r"), Request("orbit", 9), Path("o"), Path("d")),
        ),
        (
            "render r --path interpolate --view a --view test/b --time 0.5 --fps 24"
            " --output depth,rgb --video webm,mp4 --size 64x32 --supersample 2 --overwrite",
            "render",
            (
                Path("r"),
                Request(
                    "interpolate",
                    None,
                    ("a", "test/b"),
                    0.5,
                    24.0,
                    ("rgb", "depth"),
                    ("webm", "mp4"),
                    (64, 32),
                    None,
                    2,
                    True,
                ),
                None,
                None,
            ),
        ),
        (
            "render r --video none --scale 0.5",
            "render",
            (Path("r"), Request(videos=(), scale=0.5), None, None),
        ),
        (
            "export r --format ply --time 0.5 --out o",
            "export",
            (Path("r"), "ply", {"time": 0.5}, [], Path("o"), None),
        ),
        (
            "export r --format ply-sequence --frames 3 --out o",
            "export",
            (Path("r"), "ply-sequence", {"frames": 3}, [], Path("o"), None),
        ),
        (
            "export r --format ply --set time=0.5 --set a=1 --out o",
            "export",
            (Path("r"), "ply", {}, ["time=0.5", "a=1"], Path("o"), None),
        ),
        (
            "export r --format ply --axes y-up --scale 2 --sh-degree 1 --min-opacity 0.1 --lossy"
            " --out o",
            "export",
            (
                Path("r"),
                "ply",
                {"axes": "y-up", "scale": 2, "sh_degree": 1, "min_opacity": 0.1, "lossy": True},
                [],
                Path("o"),
                None,
            ),
        ),
        (
            "export r --format moving --loss 0.2 --data d --out o",
            "export",
            (Path("r"), "moving", {"loss": 0.2}, [], Path("o"), Path("d")),
        ),
        ("demo", "demo", (Path("gsdmsr-demo"),)),
        ("doctor --json", "doctor", ()),
        ("weights", "weights", ([], None, None)),
        (
            "weights --fetch vgg --fetch alex --to o --lpips-weights w --json",
            "weights",
            (["vgg", "alex"], Path("o"), Path("w")),
        ),
        ("benchmark kernels --yardstick y --json", "benchmark_kernels", (Path("y"), "cpu")),
        ("benchmark kernels --device cuda", "benchmark_kernels", (None, "cuda")),
        (
            "benchmark scenes a --out o --steps 9",
            "benchmark_scenes",
            ([Path("a")], Path("o"), ["dnerf"], [9], [0], Terms(1, "white", "test", None)),
        ),
        (
            "benchmark scenes a b --out o --preset static --preset dnerf --budget 2m --budget 8m"
            " --seed 1 --seed 2 --downscale 2 --background black --split val --lpips-weights w"
            " --jobs 2 --threads 1 --set splats.count=9 --json",
            "benchmark_scenes",
            (
                [Path("a"), Path("b")],
                Path("o"),
                ["static", "dnerf"],
                ["2m", "8m"],
                [1, 2],
                Terms(2, "black", "val", Path("w"), 2, 1, overrides=("splats.count=9",)),
            ),
        ),
        (
            "benchmark resume s --out o",
            "benchmark_resume",
            (
                Path("s"),
                Path("o"),
                "dnerf",
                ["training.steps=600", "data.downscale=4"],
                20,
                0,
                1,
            ),
        ),
        (
            "benchmark resume s --out o --preset n3v --steps 9 --downscale 2 --kills 3 --seed 5"
            " --set a.b=1 --ranks 2",
            "benchmark_resume",
            (
                Path("s"),
                Path("o"),
                "n3v",
                ["training.steps=9", "data.downscale=2", "a.b=1"],
                3,
                5,
                2,
            ),
        ),
        ("benchmark still r", "benchmark_still", (Path("r"), [0.1, 0.3, 1.0, 3.0], "val", None)),
        (
            "benchmark still r --below 0.5 --below 2 --split test --data d",
            "benchmark_still",
            (Path("r"), [0.5, 2.0], "test", Path("d")),
        ),
        ("benchmark soak -- train --data d", "benchmark_soak", (["train", "--data", "d"], 10.0)),
        ("benchmark soak --every 2 -- doctor", "benchmark_soak", (["doctor"], 2.0)),
        ("benchmark reading --out o", "benchmark_reading", (Path("o"), 10_000, 5_000_000)),
        (
            "benchmark reading --out o --pictures 5 --points 7",
            "benchmark_reading",
            (Path("o"), 5, 7),
        ),
    ],
)
def test_commands_get_typed_arguments(
    line: str, name: str, arguments: tuple[Any, ...], gsdmsr: Gsdmsr
) -> None:
    assert gsdmsr(line) == 0
    assert gsdmsr.calls == [(name, arguments)]


def test_every_exporter_is_offered(gsdmsr: Gsdmsr) -> None:
    assert {"compact", "html", "moving", "ply", "ply-sequence"} <= set(format_names())
    for name in format_names():
        assert gsdmsr(f"export r --format {name} --out o") == 0
        assert gsdmsr.calls[-1] == ("export", (Path("r"), name, {}, [], Path("o"), None))


def overrides_of(gsdmsr: Gsdmsr, options: str) -> tuple[str, ...]:
    assert gsdmsr(f"train --data d --out r {options}") == 0
    (request,) = gsdmsr.calls[-1][1]
    assert isinstance(request, Training)
    return request.overrides


def test_the_convenience_options_of_train_become_overrides(gsdmsr: Gsdmsr) -> None:
    options = "--budget 8m --downscale 2 --background black --seed 7 --threads 3"
    preset = load_preset(None, None, overrides_of(gsdmsr, f"--set training.seed=5 {options}"))
    assert (preset.training.budget, preset.training.seed, preset.training.threads) == ("8m", 7, 3)
    assert (preset.data.downscale, preset.data.background) == (2, "black")


def test_steps_put_an_end_to_a_budget(gsdmsr: Gsdmsr) -> None:
    overrides = overrides_of(gsdmsr, "--set training.budget=8m --steps 50")
    training = load_preset(None, None, overrides).training
    assert (training.steps, training.budget) == (50, None)


def test_a_budget_without_a_unit_is_refused_as_text(gsdmsr: Gsdmsr) -> None:
    with pytest.raises(UsageError, match='budget is "8"; allowed: null'):
        load_preset(None, None, overrides_of(gsdmsr, "--budget 8"))
