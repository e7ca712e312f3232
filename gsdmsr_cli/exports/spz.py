"""Writes the splats at one moment as Niantic's SPZ, version 3: 20 bytes each and harmonics."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np

from gsdmsr_cli.exports._facts import Facts
from gsdmsr_cli.exports._moment import Options, require_suffix, splats_for, write_bytes
from gsdmsr_cli.exports._packing import Array, beyond, rounded, smallest_three
from gsdmsr_cli.exports._source import Source
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.progress import OnProgress

__all__ = ["AXES", "Options", "lost", "write"]

AXES = "y-up"
"""The format prescribes x right, y up, z backward."""

MAGIC, VERSION, FRACTION_BITS = 0x5053474E, 3, 12

COLOUR_SCALE = 0.15
"""Colours are told with room below black and above white, which harmonics bring back."""

_LIMITS = {
    "means": (-2048.0, 2047.9997),
    "log_scales": (-10.0, 5.9375),
    "constants": (-0.5 / COLOUR_SCALE, 0.5 / COLOUR_SCALE),
    "harmonics": (-1.0, 1.0),
}


def lost(source: Source, options: Options) -> list[str]:
    """Return what the file cannot carry."""
    return source.lost_at(options.time) + beyond(source.at(options.time), **_LIMITS)


def write(
    source: Source, facts: Facts, options: Options, out: Path, on_progress: OnProgress
) -> list[Path]:
    """Write positions of 24 bits, rotations of 32, and all else of 8, through gzip.

    Raises:
        UsageError: ``out`` does not end in .spz.
        DataError: a splat holds NaN or infinity, or the file cannot be written.
    """
    require_suffix(out, "spz", ".spz")
    content = _content(splats_for(source, options, out))
    written = write_bytes(out, gzip.compress(content, mtime=0))
    on_progress(1, 1)
    return written


def _content(splats: Splats) -> bytes:
    header = struct.pack(
        "<IIIBBBB", MAGIC, VERSION, len(splats), splats.sh_degree, FRACTION_BITS, 0, 0
    )
    sh = splats.sh.double().numpy()
    levels = [
        splats.logit_opacities.double().sigmoid().numpy() * 255,
        sh[:, 0] * COLOUR_SCALE * 255 + 127.5,
        (splats.log_scales.double().numpy() + 10) * 16,
    ]
    parts = [_positions(splats.means.double().numpy())]
    parts += [rounded(level, 255).astype(np.uint8) for level in levels]
    parts += [_rotations(splats.quats.double().numpy())]
    parts += [rounded(sh[:, 1:] * 128 + 128, 255).astype(np.uint8)]
    return header + b"".join(part.tobytes() for part in parts)


def _positions(means: Array) -> Array:
    """Return (N, 3, 3) bytes: whole numbers of 24 bits, in steps of 1 / 4096."""
    half = 2**23
    steps = rounded(means * 2**FRACTION_BITS + half, 2 * half - 1) - half
    return steps.astype("<i4").view(np.uint8).reshape(-1, 3, 4)[:, :, :3]


def _rotations(quats: Array) -> Array:
    """Return which of x, y, z, w is largest in 2 bits, signs and sizes of the others in 1 and 9."""
    largest, others = smallest_three(np.roll(quats, -1, axis=1))
    sizes = rounded(np.abs(others) * np.sqrt(2) * 511, 511)
    parts = ((others < 0).astype(np.int64) << 9) | sizes
    packed = (largest << 30) | (parts[:, 0] << 20) | (parts[:, 1] << 10) | parts[:, 2]
    return packed.astype("<u4")
