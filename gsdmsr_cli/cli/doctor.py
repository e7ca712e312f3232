"""The options of `gsdmsr doctor`, and the call of the command with them."""

from __future__ import annotations

import typer


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(doctor)


def doctor() -> None:
    """Report what this machine offers and what is missing."""
    from gsdmsr_cli.commands import doctor as command

    command.run()
