"""The options of `gsdmsr cache`, and the call of the command with them."""

from __future__ import annotations

from typing import Annotated

import typer

from gsdmsr_cli.ground.errors import UsageError


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(cache)


def cache(
    clear: Annotated[bool, typer.Option("--clear", help="Remove compiled kernels.")] = False,
    weights: Annotated[
        bool, typer.Option("--weights", help="With --clear: the weights of LPIPS as well.")
    ] = False,
    frames: Annotated[
        bool, typer.Option("--frames", help="With --clear: decoded frames of videos as well.")
    ] = False,
) -> None:
    """Say what is kept to save time later, or remove it."""
    for option, given in (("--weights", weights), ("--frames", frames)):
        if given and not clear:
            raise UsageError(f"{option} says what --clear removes; give both or neither")
    from gsdmsr_cli.commands import cache as command

    command.run(clear, weights, frames)
