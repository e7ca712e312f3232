"""Writes moving splats as a PLY that Brush plays: the splats, and differences at each time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch

from gsdmsr_cli.exports._facts import Facts
from gsdmsr_cli.exports._moment import require_suffix
from gsdmsr_cli.exports._moving import Moving, evenly, in_the_mean, moving
from gsdmsr_cli.exports._packing import Array
from gsdmsr_cli.exports._ply import columns_of, header_of
from gsdmsr_cli.exports._source import Source
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.files import replacing
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.options.strict import require

__all__ = ["BAKES", "Options", "lost", "write"]

BAKES = True

_CHANGING = (*"xyz", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")

_KINDS = {8: ("uchar", "u1", 254), 16: ("ushort", "<u2", 65534), 32: ("float", "<f4", 0)}
"""Types of numbers of so many bits in PLY and here, and which one stands for the largest."""


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        frames: number of moments, evenly over [0, 1]; as many as the run has if None.
        bits: of each number that changes: 8, 16 or 32.
    """

    frames: int | None = None
    bits: Literal[8, 16, 32] = 16

    def __post_init__(self) -> None:
        require(self, "frames", self.frames is None or self.frames >= 1, "1 or more")

    def moments(self, facts: Facts) -> list[float]:
        """Return the moments in order, each in [0, 1]."""
        return evenly(self.frames or facts.frames)


def lost(source: Source, options: Options) -> list[str]:
    """Return what the file cannot carry; centres, sizes and rotations alone change in it."""
    times = options.moments(source.facts)
    return source.lost_at(0.0) + moving(source, len(times)).varying(times, "colours", "opacities")


def write(
    source: Source, facts: Facts, options: Options, out: Path, on_progress: OnProgress
) -> list[Path]:
    """Write the splats at 0 with colours and opacities in the mean, and all moments' differences.

    Raises:
        UsageError: ``out`` does not end in .ply.
        DataError: a splat holds NaN or infinity, or the file cannot be written.
    """
    require_suffix(out, "brush-ply", ".ply")
    times = options.moments(facts)
    moved = moving(source, len(times))
    first = in_the_mean(moved, times, moved.at(times[0]))
    elements = header_of(first) + _elements(len(times), len(first), options.bits)
    with replacing(out) as beside:
        out.parent.mkdir(parents=True, exist_ok=True)
        with beside.open("wb") as file:
            file.write("\n".join([*elements, "end_header", ""]).encode("ascii"))
            file.write(columns_of(first).tobytes())
            for frame in _frames(moved, times, first):
                for table in _coded(frame, options.bits):
                    file.write(table.tobytes())
    on_progress(1, 1)
    return [out]


def _elements(frames: int, splats: int, bits: int) -> list[str]:
    """Return the lines of the header for all moments."""
    lines = []
    for frame in range(frames):
        if bits != 32:
            for limit in ("min", "max"):
                lines += [f"element meta_delta_{limit}_{frame:05d} 1"]
                lines += [f"property float {name}" for name in _CHANGING]
        lines += [f"element delta_vertex_{frame:05d} {splats}"]
        lines += [f"property {_KINDS[bits][0]} {name}" for name in _CHANGING]
    return lines


def _frames(moved: Moving, times: list[float], first: Splats) -> Iterator[Array]:
    """Yield at each moment what is to be added to the first splats, (N, 10) float32."""
    start = _changing(first)
    for time in times:
        splats = moved.at(time)
        opposite = (splats.quats * first.quats).sum(dim=1, keepdim=True) < 0
        splats.quats.copy_(torch.where(opposite, -splats.quats, splats.quats))
        yield _changing(splats) - start


def _changing(splats: Splats) -> Array:
    table = torch.cat([splats.means, splats.log_scales, splats.quats], dim=1)
    return np.asarray(table.numpy(), "<f4")


def _coded(frame: Array, bits: int) -> list[Array]:
    """Return the tables of a moment: limits and shares of what lies between them, or itself."""
    _, kind, largest = _KINDS[bits]
    if not largest:
        return [frame]
    low, high = frame.min(axis=0, initial=np.inf), frame.max(axis=0, initial=-np.inf)
    low, high = (np.where(np.isfinite(limit), limit, 0.0).astype("<f4") for limit in (low, high))
    span = np.where(high > low, high - low, 1.0)
    return [low, high, np.rint((frame - low) / span * largest).astype(kind)]
