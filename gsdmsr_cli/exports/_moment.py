"""What exports of one moment to one file share: their options, the check of the name, writing."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gsdmsr_cli.exports._source import Source, as_written
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.files import replacing
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


def require_suffix(out: Path, format_: str, suffix: str) -> None:
    """Raise UsageError unless the name of ``out`` ends in ``suffix``."""
    if out.suffix.lower() != suffix:
        raise UsageError(
            f"--format {format_} writes one file, but '{out}' does not end in {suffix}"
        )


def splats_for(source: Source, options: Options, out: Path) -> Splats:
    """Return the splats that are to be written to ``out``, see ``as_written``."""
    return as_written(source.at(options.time), out)


def write_bytes(out: Path, content: bytes) -> list[Path]:
    """Write a file, whole or not at all, and its folder; return it as the list of files written.

    Raises:
        DataError: it cannot be written.
    """
    with replacing(out) as beside:
        out.parent.mkdir(parents=True, exist_ok=True)
        beside.write_bytes(content)
    return [out]
