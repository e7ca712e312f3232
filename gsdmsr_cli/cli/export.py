"""The options of `gsdmsr export`, and the call of the command with them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from gsdmsr_cli.cli.options import RunFolder
from gsdmsr_cli.exports import format_names

if TYPE_CHECKING:
    FormatName = str
else:
    FormatName = Literal[tuple(format_names())]


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(export)


def export(
    run_folder: RunFolder,
    format_: Annotated[FormatName, typer.Option("--format", help="Kind of file.")],
    out: Annotated[Path, typer.Option(metavar="PATH", help="File or folder to write.")],
    time: Annotated[
        float | None, typer.Option(min=0.0, max=1.0, help="Moment of a ply, 0 to 1.")
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, help="Number of files of a sequence.")
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="a=v", help="One option of the format; repeatable."),
    ] = None,
) -> None:
    """Write a run's splats for other programs."""
    from gsdmsr_cli.commands import export as command

    command.run(run_folder, format_, time, frames, set_ or [], out)
