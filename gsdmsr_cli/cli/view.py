"""The options of `gsdmsr view`, and the call of the command with them."""

from __future__ import annotations

from typing import Annotated

import typer

from gsdmsr_cli.cli.options import MovedData, RunFolder


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(view)


def view(
    run_folder: RunFolder,
    port: Annotated[
        int, typer.Option(min=0, max=65535, metavar="N", help="Port; 0 takes a free one.")
    ] = 0,
    host: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Where to listen; others need a token.")
    ] = "127.0.0.1",
    data: MovedData = None,
    open_: Annotated[bool, typer.Option("--open", help="Open a browser.")] = False,
) -> None:
    """Play a run in the browser, also while it is being trained."""
    from gsdmsr_cli.commands import view as command

    command.run(run_folder, host, port, data, open_)
