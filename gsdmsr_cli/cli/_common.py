"""The options that every command has, added to each of them in one place."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Annotated, Any

import typer

from gsdmsr_cli.cli._help import EXAMPLES, FEW, as_it_is, panel_of
from gsdmsr_cli.ground import say

PANEL = "Common options"
"""Where help lists them."""

JSON = "--json"


def common(
    as_json: Annotated[
        bool,
        typer.Option(JSON, help="Print one JSON object and nothing else.", rich_help_panel=PANEL),
    ] = False,
    quiet: Annotated[
        bool,
        typer.Option(
            "--quiet", "-q", help="Say on stderr what went wrong, no more.", rich_help_panel=PANEL
        ),
    ] = False,
    verbose: Annotated[
        bool, typer.Option("--verbose", "-v", help="Say more on stderr.", rich_help_panel=PANEL)
    ] = False,
    log_file: Annotated[
        Path | None,
        typer.Option(
            metavar="F",
            help="Append what is said on stderr to this file, with times.",
            rich_help_panel=PANEL,
        ),
    ] = None,
) -> None:
    """Do from now on what the common options want."""
    if as_json:
        say.answer_in_json()
    if quiet:
        say.speak_up_to(say.WARNINGS)
    if verbose:
        say.speak_up_to(say.DETAILS)
    if log_file is not None:
        say.log_to(log_file)


def give_common_options(app: typer.Typer) -> None:
    """Let every command of the app, and of the groups in it, have the common options.

    Their help gets its panels and an example, too.
    """
    for command in app.registered_commands:
        if command.callback is not None:
            name = command.name or command.callback.__name__
            command.epilog = f"Example: {as_it_is(EXAMPLES[name])}"
            command.callback = _with_common_options(command.callback)
    for group in app.registered_groups:
        if group.typer_instance is not None:
            give_common_options(group.typer_instance)


def _with_common_options(function: Callable[..., None]) -> Callable[..., None]:
    """Return the function with the parameters of ``common``, which is called before it."""
    own, added = (inspect.signature(f, eval_str=True).parameters for f in (function, common))

    @functools.wraps(function)
    def call(**given: Any) -> None:
        common(**{name: given.pop(name) for name in added})
        function(**given)

    _lay_out_help(own.values())
    parameters = [*own.values(), *added.values()]
    keywords = [p.replace(kind=inspect.Parameter.KEYWORD_ONLY) for p in parameters]
    call.__signature__ = inspect.Signature(keywords)  # type: ignore[attr-defined]
    call.__annotations__ = {p.name: p.annotation for p in keywords}
    return call


def _lay_out_help(parameters: Collection[inspect.Parameter]) -> None:
    """Put options into panels where there are many, and let their texts be shown as they are."""
    for parameter in parameters:
        for about in getattr(parameter.annotation, "__metadata__", ()):
            if about.help is not None and about.help != as_it_is(about.help):
                about.help = as_it_is(about.help)
            if len(parameters) > FEW and hasattr(about, "prompt"):
                about.rich_help_panel = panel_of(parameter.name)
