"""Writes the splats at one moment as a .splat file, 32 bytes each, for viewers in the browser."""

from __future__ import annotations

from pathlib import Path

import torch

from gsdmsr_cli.exports._facts import Facts
from gsdmsr_cli.exports._moment import Options, require_suffix, splats_for, write_bytes
from gsdmsr_cli.exports._packing import beyond
from gsdmsr_cli.exports._source import Source
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.ground.progress import OnProgress

__all__ = ["Options", "lost", "write"]


def lost(source: Source, options: Options) -> list[str]:
    """Return what the file cannot carry; a .splat has one colour per splat."""
    varies = ["colours that depend on the view (--sh-degree 0 leaves them out)"]
    limits = {"log_scales": (-87.0, 88.0)}  # linear scales of float32
    further = beyond(source.at(options.time), **limits)
    return source.lost_at(options.time) + (varies if source.sh_degree > 0 else []) + further


def write(
    source: Source, facts: Facts, options: Options, out: Path, on_progress: OnProgress
) -> list[Path]:
    """Write means and scales as float32, colours with opacities and quaternions wxyz as bytes.

    Raises:
        UsageError: ``out`` does not end in .splat.
        DataError: a splat holds NaN or infinity, or the file cannot be written.
    """
    require_suffix(out, "splat", ".splat")
    splats = splats_for(source, options, out)
    colours = 0.5 + SH_C0 * splats.sh[:, 0]
    rgba = torch.cat([colours, splats.logit_opacities.sigmoid()[:, None]], dim=1)
    floats = torch.cat([splats.means, splats.log_scales.exp()], dim=1).numpy().astype("<f4")
    levels = torch.cat([rgba * 255, splats.quats * 128 + 128], dim=1)
    rows = torch.cat(
        [torch.from_numpy(floats.view("u1").reshape(-1, 24)), levels.round().clamp(0, 255).byte()],
        dim=1,
    )
    written = write_bytes(out, rows.numpy().tobytes())
    on_progress(1, 1)
    return written
