"""Options and arguments that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Folder that train wrote.")]
MovedData = Annotated[
    Path | None, typer.Option("--data", metavar="DIR", help="Where the data lies now, if moved.")
]
VerifyData = Annotated[
    bool, typer.Option("--verify-data", help="Compare every byte of the pictures, not samples.")
]
Background = Literal["white", "black"]


def preset_names(incomplete: str) -> list[str]:
    """Return the presets that a shell may complete a name to."""
    from gsdmsr_cli.options import preset_files  # which takes as long as the rest of --help

    return [name for name in preset_files.preset_names() if name.startswith(incomplete)]
