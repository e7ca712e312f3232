"""The options of `gsdmsr make`, and the call of the command with them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from gsdmsr_cli.cli.options import preset_names


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(make)


def make(
    given: Annotated[
        Path,
        typer.Argument(metavar="INPUT", help="Video, folder of pictures or videos, or scene."),
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder to write; INPUT-made if not given.")
    ] = None,
    budget: Annotated[
        str, typer.Option(metavar="9m", help="Wall time of training: 90s, 8m, 1.5h.")
    ] = "9m",
    preset: Annotated[
        str | None,
        typer.Option(metavar="NAME", help="Preset to start from.", autocompletion=preset_names),
    ] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="a.b=v", help="One option; repeatable.")
    ] = None,
    frames: Annotated[int, typer.Option(min=8, metavar="N", help="Most frames to take.")] = 240,
    max_side: Annotated[
        int, typer.Option(min=64, metavar="N", help="Longer side of the pictures [px].")
    ] = 1600,
    device: Annotated[
        Literal["auto", "cpu", "cuda"], typer.Option(help="Where to compute.")
    ] = "auto",
) -> None:
    """Make a scene that plays of a video: prepare, train, evaluate, film."""
    from gsdmsr_cli.commands import make as command
    from gsdmsr_cli.commands._making import Request

    place = Path(f"{given.resolve().stem}-made") if out is None else out
    settings = budget, preset, tuple(set_ or ()), frames, max_side, device
    command.run(Request(given, place, *settings))
