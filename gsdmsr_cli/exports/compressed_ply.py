"""Writes the splats at one moment as PlayCanvas' compressed PLY, 16 bytes each and harmonics."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gsdmsr_cli.exports._facts import Facts
from gsdmsr_cli.exports._moment import Options, require_suffix, splats_for, write_bytes
from gsdmsr_cli.exports._packing import Array, beyond, morton_order, rounded, smallest_three
from gsdmsr_cli.exports._source import Source
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.ground.progress import OnProgress

__all__ = ["Options", "lost", "write"]

CHUNK = 256
"""Splats whose positions, scales and colours are told by whole numbers between common limits."""

_AXES = ("x", "y", "z", "scale_x", "scale_y", "scale_z", "r", "g", "b")
_PACKED = ("position", "rotation", "scale", "color")


def lost(source: Source, options: Options) -> list[str]:
    """Return what the file cannot carry."""
    limits = {"log_scales": (-20.0, 20.0), "harmonics": (-4.0, 4.0)}
    return source.lost_at(options.time) + beyond(source.at(options.time), **limits)


def write(
    source: Source, facts: Facts, options: Options, out: Path, on_progress: OnProgress
) -> list[Path]:
    """Write chunks of 256 splats near one another, with their limits, and harmonics of 8 bits.

    Raises:
        UsageError: ``out`` does not end in .ply.
        DataError: a splat holds NaN or infinity, or the file cannot be written.
    """
    require_suffix(out, "compressed-ply", ".ply")
    splats = splats_for(source, options, out)
    order = morton_order(splats.means.numpy())
    content = _content(splats.map(lambda tensor: tensor[order]))
    written = write_bytes(out, content)
    on_progress(1, 1)
    return written


def _content(splats: Splats) -> bytes:
    values = _values(splats)
    starts = np.arange(0, len(splats), CHUNK)
    chunks = [values[start : start + CHUNK] for start in starts]
    limits = np.array([(c.min(axis=0), c.max(axis=0)) for c in chunks], "<f4").reshape(-1, 2, 9)
    share = _shares(values, np.repeat(limits, CHUNK, axis=0)[: len(values)])
    alpha = splats.logit_opacities.sigmoid().numpy()[:, None]
    packed = [
        _packed(share[:, :3], (11, 10, 11)),
        _rotations(splats.quats.numpy()),
        _packed(share[:, 3:6], (11, 10, 11)),
        _packed(np.concatenate([share[:, 6:], alpha], axis=1), (8, 8, 8, 8)),
    ]
    # of each triple of axes the least values, then the largest
    by_triple = limits.reshape(-1, 2, 3, 3).transpose(0, 2, 1, 3)
    harmonics = splats.sh[:, 1:].transpose(1, 2).flatten(1).numpy()
    parts = [by_triple, np.stack(packed, axis=1).astype("<u4"), _harmonic_bytes(harmonics)]
    header = _header(len(starts), len(splats), harmonics.shape[1])
    return b"".join([header.encode("ascii"), *(part.tobytes() for part in parts)])


def _values(splats: Splats) -> Array:
    """Return what lies between limits of each chunk: means, log scales, colours, (N, 9)."""
    scales = splats.log_scales.clamp(-20, 20)
    tensors = (splats.means, scales, SH_C0 * splats.sh[:, 0] + 0.5)
    return np.concatenate([tensor.numpy() for tensor in tensors], axis=1)


def _shares(values: Array, limits: Array) -> Array:
    """Return where values lie between (N, 2, 9) limits, 0 to 1; 0 where these are the same."""
    low, span = limits[:, 0].astype(np.float64), np.diff(limits.astype(np.float64), axis=1)[:, 0]
    return np.where(span < 1e-5, 0.0, (values - low) / np.where(span < 1e-5, 1.0, span))


def _packed(shares: Array, bits: tuple[int, ...]) -> Array:
    """Return (N,) numbers made of columns with so many bits each, the first one highest."""
    packed = np.zeros(len(shares), np.int64)
    for column, width in zip(shares.T, bits, strict=True):
        packed = (packed << width) | rounded(column * (2**width - 1), 2**width - 1)
    return packed


def _rotations(quats: Array) -> Array:
    """Return which of w, x, y, z is largest in 2 bits, and the other three in 10 each, (N,)."""
    largest, others = smallest_three(quats)
    return (largest << 30) | _packed(others * np.sqrt(0.5) + 0.5, (10, 10, 10))


def _harmonic_bytes(harmonics: Array) -> Array:
    return np.clip(np.trunc((harmonics / 8 + 0.5) * 256), 0, 255).astype(np.uint8)


def _header(chunks: int, splats: int, harmonics: int) -> str:
    lines = ["ply", "format binary_little_endian 1.0", f"element chunk {chunks}"]
    for triple in (_AXES[:3], _AXES[3:6], _AXES[6:]):
        lines += [f"property float {limit}_{axis}" for limit in ("min", "max") for axis in triple]
    lines += [f"element vertex {splats}"]
    lines += [f"property uint packed_{name}" for name in _PACKED]
    if harmonics:
        lines += [f"element sh {splats}"]
        lines += [f"property uchar f_rest_{i}" for i in range(harmonics)]
    return "\n".join([*lines, "end_header", ""])
