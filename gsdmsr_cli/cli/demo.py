"""The options of `gsdmsr demo`, and the call of the command with them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(demo)


def demo(
    out: Annotated[Path, typer.Option(metavar="DIR", help="Folder to write.")] = Path(
        "gsdmsr-demo"
    ),
) -> None:
    """Make a small moving scene, reconstruct it and show where to look."""
    from gsdmsr_cli.commands import demo as command

    command.run(out)
