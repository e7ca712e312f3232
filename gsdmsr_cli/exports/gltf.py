"""Writes the splats at one moment as binary glTF with the extension KHR_gaussian_splatting."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

from gsdmsr_cli import __version__
from gsdmsr_cli.exports._facts import Facts
from gsdmsr_cli.exports._moment import Options, require_suffix, splats_for, write_bytes
from gsdmsr_cli.exports._packing import Array, beyond
from gsdmsr_cli.exports._source import Source
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.progress import OnProgress

__all__ = ["AXES", "Options", "lost", "write"]

AXES = "y-up"
"""glTF prescribes y up."""

EXTENSION = "KHR_gaussian_splatting"

_FLOAT, _POINTS = 5126, 0
_KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


def lost(source: Source, options: Options) -> list[str]:
    """Return what the file cannot carry."""
    limits = {"log_scales": (-87.0, 88.0)}  # linear scales of float32
    return source.lost_at(options.time) + beyond(source.at(options.time), **limits)


def write(
    source: Source, facts: Facts, options: Options, out: Path, on_progress: OnProgress
) -> list[Path]:
    """Write points with linear scales, opacities, rotations xyzw and harmonics, all as float32.

    Raises:
        UsageError: ``out`` does not end in .glb.
        DataError: a splat holds NaN or infinity, or the file cannot be written.
    """
    require_suffix(out, "gltf", ".glb")
    splats = splats_for(source, options, out)
    written = write_bytes(out, _binary(*_document(_attributes(splats) if len(splats) else {})))
    on_progress(1, 1)
    return written


def _attributes(splats: Splats) -> dict[str, Array]:
    """Return a table of float32, (N, 1), (N, 3) or (N, 4), for each attribute of the points."""
    found = {
        "POSITION": splats.means,
        f"{EXTENSION}:ROTATION": splats.quats.roll(-1, dims=1),
        f"{EXTENSION}:SCALE": splats.log_scales.exp(),
        f"{EXTENSION}:OPACITY": splats.logit_opacities.sigmoid()[:, None],
    }
    for degree in range(splats.sh_degree + 1):
        for i in range(2 * degree + 1):
            found[f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{i}"] = splats.sh[:, degree**2 + i]
    return {name: tensor.numpy().astype("<f4") for name, tensor in found.items()}


def _document(attributes: dict[str, Array]) -> tuple[dict[str, Any], bytes]:
    """Return the JSON of the file and its buffer; without splats there is an empty scene."""
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": f"gsdmsr {__version__}"},
        "scene": 0,
        "scenes": [{}],
    }
    if not attributes:
        return document, b""
    views, start = [], 0
    for table in attributes.values():
        views.append({"buffer": 0, "byteOffset": start, "byteLength": table.nbytes})
        start += table.nbytes
    accessors = [_accessor(i, name, table) for i, (name, table) in enumerate(attributes.items())]
    primitive = {
        "attributes": {name: i for i, name in enumerate(attributes)},
        "mode": _POINTS,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    document |= {
        "extensionsUsed": [EXTENSION],
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }
    return document, b"".join(table.tobytes() for table in attributes.values())


def _accessor(view: int, name: str, table: Array) -> dict[str, Any]:
    accessor: dict[str, Any] = {"bufferView": view, "componentType": _FLOAT, "count": len(table)}
    accessor |= {"type": _KINDS[table.shape[1]]}
    if name != "POSITION":
        return accessor
    return accessor | {"min": table.min(axis=0).tolist(), "max": table.max(axis=0).tolist()}


def _binary(document: dict[str, Any], buffer: bytes) -> bytes:
    """Return a GLB: a header, the JSON padded with spaces, and the buffer if there is any."""
    text = json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    if buffer:
        chunks += struct.pack("<I4s", len(buffer), b"BIN\0") + buffer
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
