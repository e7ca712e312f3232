"""gsdmsr export: writes a run's splats for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import torch
from rich.console import Console

from gsdmsr_cli import exports, plugins
from gsdmsr_cli.commands._progress import progress_bar
from gsdmsr_cli.errors import UsageError
from gsdmsr_cli.exports import Exporter, ExportOptions
from gsdmsr_cli.run import open_run


def run(run_folder: Path, format_: str, time: float | None, frames: int | None, out: Path) -> None:
    """Write the moved splats to ``out``.

    Raises:
        UsageError: both a moment and a number of frames, or what the format does not take.
        DataError: the run cannot be used, or ``out`` not be written.
    """
    if time is not None and frames is not None:
        raise UsageError("--time and --frames are both given; drop one")
    exporter = cast(Exporter, plugins.load(exports.__name__, format_.replace("-", "_")))
    model, _ = open_run(run_folder).load_model()
    with progress_bar("writing splats") as tell, torch.no_grad():
        options = ExportOptions(
            time=time or 0.0,
            frames=frames or 0,
            times=() if time is None else (time,),
            progress=tell,
        )
        written = exporter.export(model, out, options)
    count, splats = len(written), len(model.splats)
    what = f"{out}" if count == 1 else f"{out}, {count} files"
    Console().out(f"wrote {what}: {splats} splats", highlight=False)
