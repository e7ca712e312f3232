"""The options of `gsdmsr weights`, and the call of the command with them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gsdmsr_cli.ground.errors import UsageError


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(weights)


def weights(
    fetch: Annotated[
        list[str] | None,
        typer.Option(metavar="NET", help="Download what alex, squeeze or vgg lacks; repeatable."),
    ] = None,
    to: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder to download to, if not torch's.")
    ] = None,
    lpips_weights: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder to look in first.")
    ] = None,
) -> None:
    """Say which weights of LPIPS are here; download them if told to."""
    if to is not None and not fetch:
        raise UsageError("--to is where --fetch downloads to; give both or neither")
    from gsdmsr_cli.commands import weights as command

    command.run(fetch or [], to, lpips_weights)
