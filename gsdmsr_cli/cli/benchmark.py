"""The options of `gsdmsr benchmark`, and the call of the command with them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from gsdmsr_cli.cli.options import Background, preset_names
from gsdmsr_cli.ground.errors import UsageError


def register(app: typer.Typer) -> None:
    """Add the group of commands."""
    group = typer.Typer(help="Measure speed.", no_args_is_help=True)
    group.command()(kernels)
    group.command()(scenes)
    group.command()(resume)
    group.command()(still)
    group.command()(soak)
    group.command()(reading)
    app.add_typer(group, name="benchmark")


def kernels(
    yardstick: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of other kernels to compare with.")
    ] = None,
    device: Annotated[Literal["cpu", "cuda"], typer.Option(help="What to time.")] = "cpu",
) -> None:
    """Time drawing and a training step, forward and backward."""
    from gsdmsr_cli.commands import benchmark_kernels as command

    command.run(yardstick, device)


def scenes(
    folders: Annotated[list[Path], typer.Argument(metavar="SCENE...", help="Scene folders.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the runs and the table.")],
    preset: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Preset; repeatable.", autocompletion=preset_names),
    ] = None,
    config: Annotated[
        list[Path] | None,
        typer.Option(metavar="F.yaml", help="File of options in place of a preset; repeatable."),
    ] = None,
    budget: Annotated[
        list[str] | None, typer.Option(metavar="8m", help="Wall time of a training; repeatable.")
    ] = None,
    steps: Annotated[
        list[int] | None, typer.Option(metavar="N", help="Steps of a training; repeatable.")
    ] = None,
    seed: Annotated[list[int] | None, typer.Option(metavar="N", help="Seed; repeatable.")] = None,
    downscale: Annotated[
        int, typer.Option(min=1, metavar="N", help="Divide both sides of pictures by N.")
    ] = 1,
    background: Annotated[
        Background, typer.Option(help="Colour behind transparent pixels.")
    ] = "white",
    split: Annotated[Literal["test", "val"], typer.Option(help="Views to compare.")] = "test",
    lpips_weights: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of LPIPS weights.")
    ] = None,
    jobs: Annotated[
        int,
        typer.Option(min=1, metavar="N", help="Trials side by side, each on its share of cores."),
    ] = 1,
    threads: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="CPU threads of each trial.")
    ] = None,
    workers: Annotated[
        str | None,
        typer.Option(
            metavar="ray://HOST:PORT|auto|N", help="Run trials on a cluster of Ray; needs ray."
        ),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="a.b=v", help="One option of all trainings; repeatable."),
    ] = None,
) -> None:
    """Train presets on scenes at equal lengths and print the table of their scores."""
    lengths: list[str | int] = [*(budget or []), *(steps or [])]
    if not lengths:
        raise UsageError("how long is a training? give --budget 8m or --steps N, or several")
    from gsdmsr_cli.benchmark.trials import Terms
    from gsdmsr_cli.commands import benchmark_scenes as command

    if workers is not None and jobs > 1:
        raise UsageError("--jobs and --workers are both given; drop one")
    given = downscale, background, split, lpips_weights, jobs, threads, workers
    terms = Terms(*given, tuple(overrides or []))
    presets: list[str | Path] = [*(preset or []), *(config or [])]
    command.run(folders, out, presets or ["dnerf"], lengths, seed or [0], terms)


def resume(
    folder: Annotated[Path, typer.Argument(metavar="SCENE", help="Scene folder.")],
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder of the runs.")],
    preset: Annotated[str, typer.Option(metavar="NAME", help="Preset.")] = "dnerf",
    steps: Annotated[int, typer.Option(min=1, metavar="N", help="Steps of a training.")] = 600,
    downscale: Annotated[
        int, typer.Option(min=1, metavar="N", help="Divide both sides of pictures by N.")
    ] = 4,
    kills: Annotated[int, typer.Option(min=1, metavar="N", help="Trainings to kill.")] = 20,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Seed of the moments.")] = 0,
    ranks: Annotated[
        int, typer.Option(min=1, metavar="N", help="Ranks of torchrun, one of which is killed.")
    ] = 1,
    overrides: Annotated[
        list[str] | None, typer.Option("--set", metavar="a.b=v", help="One option; repeatable.")
    ] = None,
) -> None:
    """Kill trainings at random moments, resume them, and compare how they end."""
    from gsdmsr_cli.commands import benchmark_resume as command

    asked = [f"training.steps={steps}", f"data.downscale={downscale}", *(overrides or [])]
    command.run(folder, out, preset, asked, kills, seed, ranks)


def still(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder.")],
    below: Annotated[
        list[float] | None,
        typer.Option(metavar="X", help="Motion saliency; repeatable. [default: 0.1 0.3 1 3]"),
    ] = None,
    split: Annotated[Literal["test", "val"], typer.Option(help="Views to compare.")] = "val",
    data: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Where the data lies now, if elsewhere.")
    ] = None,
) -> None:
    """Let what hardly moves stand still, and measure PSNR and frames a second."""
    from gsdmsr_cli.commands import benchmark_still as command

    command.run(run, below or [0.1, 0.3, 1.0, 3.0], split, data)


def soak(
    command: Annotated[
        list[str], typer.Argument(metavar="-- COMMAND...", help="What to run, without gsdmsr.")
    ],
    every: Annotated[
        float, typer.Option(min=0.1, metavar="S", help="Seconds between two samples.")
    ] = 10.0,
) -> None:
    """Run a long command and tell whether its memory and open files grow."""
    from gsdmsr_cli.commands import benchmark_soak

    benchmark_soak.run(command, every)


def reading(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write the capture to.")],
    pictures: Annotated[int, typer.Option(min=2, metavar="N", help="Pictures.")] = 10_000,
    points: Annotated[int, typer.Option(min=1, metavar="N", help="Points.")] = 5_000_000,
) -> None:
    """Write a large COLMAP model and measure how it is read: time and memory."""
    from gsdmsr_cli.commands import benchmark_reading as command

    command.run(out, pictures, points)
