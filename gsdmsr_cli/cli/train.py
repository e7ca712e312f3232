"""The options of `gsdmsr train`, and the call of the command with them."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import typer

from gsdmsr_cli.cli.options import Background, VerifyData, preset_names
from gsdmsr_cli.ground.errors import UsageError

_STREAMED = "persistent"
"""The preset that --stream takes where none is named."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(train)


def train(
    data: Annotated[Path, typer.Option(metavar="DIR", help="Scene folder, such as a D-NeRF one.")],
    out: Annotated[Path, typer.Option(metavar="RUN", help="Run folder to write.")],
    preset: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Preset to start from.", autocompletion=preset_names),
    ] = None,
    config: Annotated[
        Path | None, typer.Option(metavar="F.yaml", help="File of options over the preset.")
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="a.b=v", help="One option; repeatable.")
    ] = None,
    budget: Annotated[
        str | None, typer.Option(metavar="8m", help="Wall time of training: 90s, 8m, 1.5h.")
    ] = None,
    steps: Annotated[
        int | None, typer.Option(metavar="N", help="Number of steps instead of a budget.")
    ] = None,
    downscale: Annotated[
        int | None, typer.Option(metavar="N", help="Divide both sides of pictures by N.")
    ] = None,
    background: Annotated[
        Background | None, typer.Option(help="Colour behind transparent pixels.")
    ] = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Seed of random choices.")] = None,
    device: Annotated[
        Literal["auto", "cpu", "cuda"], typer.Option(help="Where to compute.")
    ] = "auto",
    threads: Annotated[
        int | None, typer.Option(metavar="N", help="CPU threads; 0 takes all cores.")
    ] = None,
    keep: Annotated[
        int | None, typer.Option(metavar="N", help="How many of the last checkpoints to keep.")
    ] = None,
    stream: Annotated[
        bool, typer.Option("--stream", help="Train one moment after the other; see stream.md.")
    ] = False,
    segments: Annotated[
        int | None,
        typer.Option(min=1, metavar="N", help="Cut the time into N trainings; see segments.md."),
    ] = None,
    jobs: Annotated[
        int, typer.Option(min=1, metavar="N", help="Segments trained side by side.")
    ] = 1,
    workers: Annotated[
        str | None,
        typer.Option(
            metavar="ray://HOST:PORT|auto|N", help="Train segments on a cluster of Ray; needs ray."
        ),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Go on from RUN's last checkpoint.")
    ] = False,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an earlier RUN.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Check everything, say what would be done, and stop.")
    ] = False,
    verify_data: VerifyData = False,
    tensorboard: Annotated[
        bool, typer.Option("--tensorboard", help="Log to RUN/tensorboard too; needs tensorboardX.")
    ] = False,
    wandb: Annotated[
        str | None,
        typer.Option(metavar="PROJECT", help="Log to Weights & Biases too; needs wandb."),
    ] = None,
    live: Annotated[
        bool, typer.Option("--view", help="Serve a page that shows the training.")
    ] = False,
    port: Annotated[
        int, typer.Option(min=0, max=65535, metavar="N", help="Port of that page; 0 a free one.")
    ] = 0,
) -> None:
    """Reconstruct a moving scene from its pictures."""
    if budget is not None and steps is not None:
        raise UsageError("--budget and --steps are both given; drop one")
    from gsdmsr_cli.training.request import Request

    options = {
        "training.budget": budget,
        "training.steps": steps,
        "data.downscale": downscale,
        "data.background": background,
        "training.seed": seed,
        "training.threads": threads,
        "training.keep": keep,
        "stream.enabled": stream or None,
        "segments.count": segments,
    }
    if stream and not resume:
        preset = preset or _STREAMED
    overrides = *(set_ or ()), *_overrides(options)
    named = data, out, preset, config, overrides, device
    request = Request(*named, resume, overwrite, dry_run, verify_data, tensorboard, wandb)
    request = replace(request, view_port=port if live else None, jobs=jobs, workers=workers)
    from gsdmsr_cli.commands import train as command

    command.run(request)


def _overrides(options: dict[str, str | int | None]) -> list[str]:
    """Return ``--set`` texts of the options that are given; steps put an end to a budget."""
    given = {key: value for key, value in options.items() if value is not None}
    no_budget = ["training.budget=null"] if "training.steps" in given else []
    return no_budget + [f"{key}={json.dumps(value)}" for key, value in given.items()]
