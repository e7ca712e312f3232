"""Writes a run whose model is packed into few bytes; eval, render and export read it as any other.

See ``runs.packing`` for what it holds. It cannot be trained further.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import cast

from gsdmsr_cli.exports._facts import Facts, RunFacts
from gsdmsr_cli.exports._source import Source
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.options.strict import require
from gsdmsr_cli.runs import checkpoints
from gsdmsr_cli.runs.packing import TOLERANCE, pack

WHOLE = True


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        tolerance: how far what is drawn may be off by rounding, see ``tolerance.distance``: centres
            in units of the splats' sizes, rotations [rad], log scales, opacities and colours.
    """

    tolerance: float = TOLERANCE

    def __post_init__(self) -> None:
        require(self, "tolerance", 0 <= self.tolerance <= 1, "0 to 1; less is nearer and larger")


def lost(source: Source, options: Options) -> list[str]:
    """Return nothing: a run carries the whole model, at fewer bits a value."""
    return []


def write(
    source: Source, facts: Facts, options: Options, out: Path, on_progress: OnProgress
) -> list[Path]:
    """Write the model to the run folder ``out``, which must be new or empty.

    Raises:
        DataError: there is something already, a value is not finite, or the file cannot be
            written.
    """
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise DataError(f"{out}: exists; --format compact writes a new run, choose another --out")
    tensors, described = pack(source.model, options.tolerance)
    run = cast(RunFacts, facts)
    run.describe(out)
    path = checkpoints.save_packed(out, tensors, described, run.step, run.progress)
    on_progress(1, 1)
    return [path]
