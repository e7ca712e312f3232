"""The options of `gsdmsr info`, and the call of the command with them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(info)


def info(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="PATH", help="Run, scene, video, folder of pictures, PLY or report."
        ),
    ],
) -> None:
    """Say what lies at a path, and whether it is sound."""
    from gsdmsr_cli.commands import info as command

    command.run(path)
