"""Options and arguments that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Folder that train wrote.")]
MovedData = Annotated[
    Path | None, typer.Option("--data", metavar="DIR", help="Where the data lies now, if moved.")
]
Background = Literal["white", "black"]
