"""The options of `gsdmsr export`, and the call of the command with them."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from gsdmsr_cli.cli.options import RunFolder
from gsdmsr_cli.exports import format_names
from gsdmsr_cli.exports._asked import Axes

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
        float | None, typer.Option(min=0.0, max=1.0, help="Moment that is written, 0 to 1.")
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, help="Number of files of a sequence.")
    ] = None,
    axes: Annotated[
        Axes | None,
        typer.Option(help="Axes of the file, of a scene with z up; the format's or the scene's."),
    ] = None,
    scale: Annotated[
        float | None, typer.Option(help="Units of the file in one of the scene.")
    ] = None,
    sh_degree: Annotated[
        int | None, typer.Option(min=0, max=3, help="Harmonics of higher degrees are left out.")
    ] = None,
    min_opacity: Annotated[
        float | None, typer.Option(min=0.0, max=1.0, help="Fainter splats are left out.")
    ] = None,
    lossy: Annotated[
        bool, typer.Option("--lossy", help="Leave out what the format cannot carry.")
    ] = False,
    loss: Annotated[
        float | None,
        typer.Option(metavar="DB", help="PSNR that coding may cost in files that are played."),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(metavar="DIR", help="Where the data lies now, to measure that loss."),
    ] = None,
    embed: Annotated[
        str | None,
        typer.Option(
            metavar="URL", help="Where an HTML page finds its file, instead of in itself."
        ),
    ] = None,
    set_: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="a=v", help="One option of the format; repeatable."),
    ] = None,
) -> None:
    """Write a run's splats for other programs."""
    from gsdmsr_cli.commands import export as command

    given = {
        "time": time,
        "frames": frames,
        "axes": axes,
        "scale": scale,
        "sh_degree": sh_degree,
        "min_opacity": min_opacity,
        "lossy": lossy or None,
        "loss": loss,
        "embed": embed,
    }
    named = {key: value for key, value in given.items() if value is not None}
    command.run(run_folder, format_, named, set_ or [], out, data)
