"""Writes the splats at one moment as a 3DGS PLY file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gsdmsr_cli.exports import Facts
from gsdmsr_cli.exports._ply import lost_at, splats_at, write_ply
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.options.strict import require


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        time: the moment whose splats are written, in [0, 1].
    """

    time: float = 0.0

    def __post_init__(self) -> None:
        require(self, "time", 0 <= self.time <= 1, "0 to 1, from the first frame to the last")


def lost(model: Model, options: Options) -> list[str]:
    """Return what the file cannot carry; the motion is not lost, since one moment is asked for."""
    return lost_at(model, options.time)


def write(
    model: Model, facts: Facts, options: Options, out: Path, on_progress: OnProgress
) -> list[Path]:
    """Write the splats at ``options.time`` to the file ``out``, replacing what was there.

    Raises:
        UsageError: ``out`` does not end in .ply.
        DataError: a splat holds NaN or infinity, or the file cannot be written.
    """
    if out.suffix.lower() != ".ply":
        raise UsageError(f"--format ply writes one file, but '{out}' does not end in .ply")
    write_ply(out, splats_at(model, options.time))
    on_progress(1, 1)
    return [out]
