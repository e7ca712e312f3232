"""Writes the splats at one moment as PlayCanvas' SOG, version 2: WebP pictures in a ZIP."""

from __future__ import annotations

import io
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from gsdmsr_cli import __version__
from gsdmsr_cli.exports._codebooks import codebook, palette
from gsdmsr_cli.exports._facts import Facts
from gsdmsr_cli.exports._moment import Options, require_suffix, splats_for, write_bytes
from gsdmsr_cli.exports._packing import Array, morton_order, rounded, smallest_three
from gsdmsr_cli.exports._source import Source
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.scene.imaging import encode_lossless_webp

__all__ = ["Options", "lost", "write"]

LARGEST_TAG = 252
"""Alpha of a rotation whose w is the largest; x, y and z follow."""

ROW, MOST_ROWS = 64, 8192
"""Harmonics side by side in a picture, and different ones in a file: 65536 would take minutes."""


def lost(source: Source, options: Options) -> list[str]:
    """Return what the file cannot carry."""
    return source.lost_at(options.time)


def write(
    source: Source, facts: Facts, options: Options, out: Path, on_progress: OnProgress
) -> list[Path]:
    """Write positions of 16 bits, all else of 8, and as few different harmonics as is usual.

    Raises:
        UsageError: ``out`` does not end in .sog.
        DataError: a splat holds NaN or infinity, or the file cannot be written.
    """
    require_suffix(out, "sog", ".sog")
    splats = splats_for(source, options, out)
    order = morton_order(splats.means.numpy())
    meta, pictures = _content(splats.map(lambda tensor: tensor[order]))
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:  # pictures are compressed already
        text = json.dumps(meta, allow_nan=False, separators=(",", ":"))
        archive.writestr(zipfile.ZipInfo("meta.json"), text)
        for name, pixels in pictures.items():
            archive.writestr(zipfile.ZipInfo(name), encode_lossless_webp(pixels))
    written = write_bytes(out, packed.getvalue())
    on_progress(1, 1)
    return written


def _content(splats: Splats) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return the description, and the pictures by name: (H, W, 3 or 4) bytes."""
    means, (low, high) = _means(splats.means.double().numpy())
    scales, scale = codebook(splats.log_scales.numpy())
    colours, colour = codebook(splats.sh[:, 0].numpy())
    # alpha 0 would let an encoder forget the colours under it; such splats are never seen
    alpha = rounded(splats.logit_opacities.double().sigmoid().numpy() * 255, 255).clip(1)
    tables = {
        "means_l.webp": means & 255,
        "means_u.webp": means >> 8,
        "scales.webp": scale,
        "quats.webp": _rotations(splats.quats.double().numpy()),
        "sh0.webp": np.concatenate([colour, alpha[:, None]], axis=1),
    }
    meta = {
        "version": 2,
        "asset": {"generator": f"gsdmsr {__version__}"},
        "count": len(splats),
        "means": {"mins": low, "maxs": high, "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colours.tolist(), "files": ["sh0.webp"]},
    }
    pictures = {name: _picture(table) for name, table in tables.items()}
    if splats.sh_degree and len(splats):
        about, further = _harmonics(splats)
        meta["shN"], pictures = about, pictures | further
    return meta, pictures


def _means(means: Array) -> tuple[Array, tuple[list[float], list[float]]]:
    """Return numbers of 16 bits (N, 3) and their limits, of logarithms that keep the sign."""
    logs = np.sign(means) * np.log1p(np.abs(means))
    if not len(logs):
        return np.zeros((0, 3), np.int64), ([0.0] * 3, [0.0] * 3)
    low, high = logs.min(axis=0), logs.max(axis=0)
    shares = (logs - low) / np.where(high > low, high - low, 1.0)
    return rounded(shares * 65535, 65535), (low.tolist(), high.tolist())


def _rotations(quats: Array) -> Array:
    """Return the three smaller components of w, x, y, z and which one is largest, (N, 4)."""
    largest, others = smallest_three(quats)
    shares = rounded((others * np.sqrt(0.5) + 0.5) * 255, 255)
    return np.concatenate([shares, LARGEST_TAG + largest[:, None]], axis=1)


def _harmonics(splats: Splats) -> tuple[dict[str, Any], dict[str, Array]]:
    """Return the description of the higher harmonics, and the pictures of them and their places."""
    rows = splats.sh[:, 1:].flatten(1).numpy()
    thousands = 2 ** int(math.log2(max(len(rows) // 1024, 1)))
    chosen, labels = palette(rows, min(1024 * thousands, MOST_ROWS))
    codes, places = codebook(chosen)
    width = splats.sh.shape[1] - 1
    table = np.zeros((-(-len(chosen) // ROW) * ROW, width, 3), np.uint8)
    table[: len(chosen)] = places.reshape(-1, width, 3)
    files = ["shN_centroids.webp", "shN_labels.webp"]
    about = {"count": len(chosen), "bands": splats.sh_degree, "codebook": codes.tolist()}
    of_splats = np.stack([labels & 255, labels >> 8, np.zeros_like(labels)], axis=1)
    pictures = (table.reshape(-1, ROW * width, 3), _picture(of_splats))
    return {**about, "files": files}, dict(zip(files, pictures, strict=True))


def _picture(table: Array) -> Array:
    """Return a nearly square picture of a row for each splat; what is left over is opaque black."""
    width = 4 * max(1, math.ceil(math.sqrt(len(table)) / 4))
    height = 4 * max(1, math.ceil(len(table) / width / 4))
    pixels = np.zeros((height * width, table.shape[1]), np.uint8)
    pixels[:, 3:] = 255
    pixels[: len(table)] = table
    return pixels.reshape(height, width, -1)
