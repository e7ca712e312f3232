"""The options of `gsdmsr render`, and the call of the command with them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gsdmsr_cli.cli.options import MovedData, RunFolder


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(render)


def render(
    run_folder: RunFolder,
    path: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|F.json",
            help="test, val, train, orbit, spiral, dolly, interpolate, still, or a file of "
            "keyframes; test and orbit if not given.",
        ),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, max=100_000, metavar="N", help="Frames of a made path.")
    ] = None,
    view: Annotated[
        list[str] | None,
        typer.Option(metavar="[SPLIT/]NAME", help="View that the path begins at; repeatable."),
    ] = None,
    time: Annotated[
        float | None, typer.Option(min=0.0, max=1.0, metavar="T", help="Stop time there, 0 to 1.")
    ] = None,
    fps: Annotated[
        float | None, typer.Option(metavar="X", help="Frames a second of videos.")
    ] = None,
    output: Annotated[
        str, typer.Option(metavar="A,B", help="Any of rgb, depth, alpha, flow, error.")
    ] = "rgb",
    video: Annotated[
        str, typer.Option(metavar="A,B", help="Any of webm, mp4, webp; or none.")
    ] = "webm",
    size: Annotated[
        str | None, typer.Option(metavar="WxH", help="Size of the pictures [px].")
    ] = None,
    scale: Annotated[
        float | None, typer.Option(metavar="X", help="Factor on the size of training.")
    ] = None,
    supersample: Annotated[
        int, typer.Option(min=1, max=8, metavar="N", help="Mean of N x N pixels for each.")
    ] = 1,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Draw again what is there already.")
    ] = False,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="Folder to write.")] = None,
    data: MovedData = None,
) -> None:
    """Draw a run to pictures, numbers and videos."""
    from gsdmsr_cli.filming.request import Request, outputs_of, size_of, videos_of

    request = Request(
        path=path,
        frames=frames,
        views=tuple(view or ()),
        time=time,
        fps=fps,
        outputs=outputs_of(output),
        videos=videos_of(video),
        size=None if size is None else size_of(size),
        scale=scale,
        supersample=supersample,
        overwrite=overwrite,
    )
    from gsdmsr_cli.commands import render as command

    command.run(run_folder, request, out, data)
