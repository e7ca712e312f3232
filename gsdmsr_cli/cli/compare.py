"""The options of `gsdmsr compare`, and the call of the command with them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gsdmsr_cli.cli.options import MovedData


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(compare)


def compare(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN...", help="Run folders, or files metrics.json of eval."),
    ],
    out: Annotated[
        Path | None, typer.Option(metavar="F.html", help="Page to write, with pictures.")
    ] = None,
    data: MovedData = None,
) -> None:
    """Set evaluated runs side by side."""
    from gsdmsr_cli.commands import compare as command

    command.run(runs, out, data)
