"""The options of `gsdmsr presets`, and the call of the command with them."""

from __future__ import annotations

from typing import Annotated

import typer

from gsdmsr_cli.cli.options import preset_names


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(presets)


def presets(
    name: Annotated[
        str | None,
        typer.Argument(
            metavar="NAME", help="Preset whose options are listed.", autocompletion=preset_names
        ),
    ] = None,
) -> None:
    """List presets, or all options of one with their meanings."""
    from gsdmsr_cli.commands import presets as command

    command.run(name)
