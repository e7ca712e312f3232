"""Writes moving splats as a .splatv file, 64 bytes each, for the players splaTV and gsplat.js."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from gsdmsr_cli.exports._cubics import LARGEST, Cubics, fit
from gsdmsr_cli.exports._facts import Facts
from gsdmsr_cli.exports._moment import require_suffix, write_bytes
from gsdmsr_cli.exports._moving import LEAST_TIMES, evenly, moving
from gsdmsr_cli.exports._packing import Array, beyond, rounded
from gsdmsr_cli.exports._source import Source
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.ground.progress import OnProgress

__all__ = ["BAKES", "Options", "lost", "write"]

BAKES = True

MAGIC = 0x674B

ROW = 1024
"""Splats in a row of the texture, of 4 texels each."""

MOST_TIMES = 64
"""At which the cubics are fitted; more of them hardly change four coefficients."""

TOLERATED_PATH, TOLERATED_TURN, TOLERATED_OPACITY = 5e-3, math.radians(2), 0.02
"""How far from the model splats may be: shares of the scene's bound, angles, shares of opacity."""

_SPLAT = np.dtype([
    ("mean", "<f4", 3), ("quat", "<f2", 4), ("scale", "<f2", 3), ("zero", "<f2"), ("rgba", "u1", 4),
    ("path", "<f2", 9), ("nought", "<f2"), ("rate", "<f2", 4), ("centre", "<f2"), ("width", "<f2"),
])  # fmt: skip

_FORWARD = ((1, 0, 0), (0, 0, 1), (0, -1, 0))
"""Axes of a camera, as columns in a world with z up, that looks along y."""


@dataclass(frozen=True)
class Options:
    """There are none of its own."""


def lost(source: Source, options: Options) -> list[str]:
    """Return what the file cannot carry, and how far splats are from where they should be."""
    cubics, bound = _fitted(source), source.facts.bound * source.asked.scale
    views = ["colours that depend on the view (--sh-degree 0 leaves them out)"]
    varying = moving(source, source.facts.frames).varying(_times(source), "colours", "sizes")
    centres, turns, opacities = (
        (float(off.max()), float(off.sum() / off.count_nonzero().clamp(min=1)))
        if off.numel() else (0.0, 0.0) for off in cubics.off.values()
    )  # fmt: skip
    phrases = source.lost_at(0.0) + (views if source.sh_degree > 0 else []) + varying
    if centres[0] > TOLERATED_PATH * bound:
        mean, most = (f"{100 * off / bound:.2g} %" for off in centres[::-1])
        phrases.append(
            f"paths that are no cubics of time (centres are off by {mean} of the scene's bound in "
            f"the mean, {most} at most)"
        )
    if turns[0] > TOLERATED_TURN:
        mean, most = (f"{math.degrees(off):.2g}" for off in turns[::-1])
        phrases.append(
            f"rotations at changing rates (off by {mean} degrees in the mean, {most} at most)"
        )
    if opacities[0] > TOLERATED_OPACITY:
        phrases.append(
            "opacities that change otherwise than as a Gaussian of time (off by "
            f"{opacities[0]:.2g} at most)"
        )
    return phrases + beyond(cubics.splats, log_scales=(-87.0, math.log(LARGEST)))


def write(
    source: Source, facts: Facts, options: Options, out: Path, on_progress: OnProgress
) -> list[Path]:
    """Write positions at the centres in time, cubics of time, and a camera that sees the scene.

    Raises:
        UsageError: ``out`` does not end in .splatv.
        DataError: a splat holds NaN or infinity, or the file cannot be written.
    """
    require_suffix(out, "splatv", ".splatv")
    rows = _rows(_fitted(source))
    texels = rows.tobytes() + bytes(-len(rows) % ROW * _SPLAT.itemsize)
    chunk = {
        "type": "splat", "size": len(texels), "texwidth": 4 * ROW,
        "texheight": len(texels) // (ROW * _SPLAT.itemsize), "cameras": [_camera(source)],
    }  # fmt: skip
    text = json.dumps([chunk], allow_nan=False, separators=(",", ":")).encode()
    written = write_bytes(out, struct.pack("<II", MAGIC, len(text)) + text + texels)
    on_progress(1, 1)
    return written


def _times(source: Source) -> list[float]:
    return evenly(min(max(source.facts.frames, LEAST_TIMES), MOST_TIMES))


@lru_cache(maxsize=1)  # once for what is lost, and once for the file
def _fitted(source: Source) -> Cubics:
    return fit(moving(source, source.facts.frames), _times(source))


def _rows(cubics: Cubics) -> Array:
    splats = cubics.splats
    rows = np.zeros(len(splats), _SPLAT)
    colours = 0.5 + SH_C0 * splats.sh[:, 0].numpy()
    alpha = splats.logit_opacities.sigmoid().numpy()[:, None]
    rows["mean"], rows["quat"] = splats.means.numpy(), splats.quats.numpy()
    rows["scale"] = np.minimum(splats.log_scales.exp().numpy(), LARGEST)
    rows["rgba"] = rounded(np.concatenate([colours, alpha], axis=1) * 255, 255)
    rows["path"] = cubics.paths.flatten(1).numpy()
    rows["rate"] = cubics.rates.numpy()
    rows["centre"], rows["width"] = cubics.centres.numpy(), cubics.widths.numpy()
    return rows


def _camera(source: Source) -> dict[str, Any]:
    """Return a camera in front of the scene, x right, y down, z ahead: players begin there."""
    axes = source.rotation.numpy() @ np.array(_FORWARD)
    away = 3 * source.facts.bound * source.asked.scale
    return {
        "id": 0, "img_name": "front", "width": 1600, "height": 1200, "fx": 1600.0, "fy": 1600.0,
        "position": (-away * axes[:, 2]).tolist(), "rotation": axes.tolist(),
    }  # fmt: skip
