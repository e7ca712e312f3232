"""Writes moving splats as OpenUSD's ParticleField3DGaussianSplat, with a sample for each moment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gsdmsr_cli.exports._facts import Facts
from gsdmsr_cli.exports._moving import evenly, moving
from gsdmsr_cli.exports._packing import Array
from gsdmsr_cli.exports._source import Source
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.files import replacing
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.options.strict import require

__all__ = ["BAKES", "Options", "lost", "write"]

BAKES = True

SUFFIXES = ".usd", ".usda", ".usdc"

PLACE = "/splats"
"""Of the splats in the stage; they are what it shows by default."""


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        frames: number of moments, evenly over [0, 1]; as many as the run has if None.
        fps: moments in a second, above 0.
    """

    frames: int | None = None
    fps: float = 24.0

    def __post_init__(self) -> None:
        require(self, "frames", self.frames is None or self.frames >= 1, "1 or more")
        require(self, "fps", 0 < self.fps <= 1000, "above 0 and at most 1000")


def lost(source: Source, options: Options) -> list[str]:
    """Return what the file cannot carry."""
    return source.lost_at(0.0)


def write(
    source: Source, facts: Facts, options: Options, out: Path, on_progress: OnProgress
) -> list[Path]:
    """Write a stage whose frames 0, 1, ... are the moments; what does not change has one value.

    Raises:
        UsageError: ``out`` does not end in .usd, .usda or .usdc, or OpenUSD is not installed.
        DataError: a splat holds NaN or infinity, or the file cannot be written.
    """
    if out.suffix.lower() not in SUFFIXES:
        raise UsageError(
            f"--format usd writes one file, but '{out}' does not end in {', '.join(SUFFIXES)}"
        )
    pxr = _load()
    times = evenly(options.frames or facts.frames)
    stage = _stage(pxr, source, len(times), options.fps)
    field = pxr.UsdVol.ParticleField3DGaussianSplat.Define(stage, PLACE)
    stage.SetDefaultPrim(field.GetPrim())
    moved = moving(source, len(times))
    _fill(pxr, field, [partial(moved.at, time) for time in times], on_progress)
    with replacing(out) as beside:
        out.parent.mkdir(parents=True, exist_ok=True)
        try:
            done = stage.GetRootLayer().Export(str(beside))
        except pxr.Tf.ErrorException:
            done = False
        if not done:
            raise DataError(f"{out}: cannot be written; choose another --out or free space")
    return [out]


def _load() -> Any:
    """Return OpenUSD's modules, or raise UsageError."""
    try:
        import pxr.Tf
        import pxr.Usd
        import pxr.UsdGeom
        import pxr.UsdVol
        import pxr.Vt

        known = hasattr(pxr.UsdVol, "ParticleField3DGaussianSplat")
    except ImportError:
        known = False
    if not known:
        raise UsageError("--format usd needs OpenUSD 26.3 or newer: pip install 'gsdmsr[usd]'")
    return pxr


def _stage(pxr: Any, source: Source, frames: int, fps: float) -> Any:
    """Return a stage that has the axes of the file, of which those with y down have no name."""
    stage = pxr.Usd.Stage.CreateInMemory()
    if source.asked.axes != "opencv":
        names = pxr.UsdGeom.Tokens
        pxr.UsdGeom.SetStageUpAxis(stage, names.y if source.asked.axes == "y-up" else names.z)
    stage.SetTimeCodesPerSecond(fps)
    stage.SetFramesPerSecond(fps)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(frames - 1)
    return stage


def _fill(
    pxr: Any, field: Any, moments: list[Callable[[], Splats]], on_progress: OnProgress
) -> None:
    """Give the attributes a value at each moment before or after which they change, or one."""
    field.CreateRadianceSphericalHarmonicsDegreeAttr(moments[0]().sh_degree)
    attributes = {
        "positions": field.CreatePositionsAttr(),
        "orientations": field.CreateOrientationsAttr(),
        "scales": field.CreateScalesAttr(),
        "opacities": field.CreateOpacitiesAttr(),
        "harmonics": field.CreateRadianceSphericalHarmonicsCoefficientsAttr(),
        "extent": field.CreateExtentAttr(),
    }
    last: dict[str, Array] = {}
    for frame, moment in enumerate(moments):
        for name, table in _tables(moment()).items():
            attribute, before = attributes[name], last.get(name)
            if before is None:
                attribute.Set(_value(pxr, name, table))
            elif not np.array_equal(before, table):
                attribute.Set(_value(pxr, name, before), frame - 1)
                attribute.Set(_value(pxr, name, table), frame)
            last[name] = table
        on_progress(frame + 1, len(moments))


def _tables(splats: Splats) -> dict[str, Array]:
    """Return float32 tables by the attributes' names; quaternions are x, y, z, w."""
    scales = splats.log_scales.exp()
    reach = 3 * scales.amax(dim=1, keepdim=True)
    corners = [splats.means - reach, splats.means + reach]
    box = [corners[0].amin(dim=0), corners[1].amax(dim=0)] if len(splats) else [torch.zeros(3)] * 2
    found = {
        "positions": splats.means,
        "orientations": splats.quats.roll(-1, dims=1),
        "scales": scales,
        "opacities": splats.logit_opacities.sigmoid(),
        "harmonics": splats.sh.flatten(0, 1),
        "extent": torch.stack(box),
    }
    return {name: np.ascontiguousarray(tensor.numpy()) for name, tensor in found.items()}


def _value(pxr: Any, name: str, table: Array) -> Any:
    """Return a table as OpenUSD takes it."""
    kinds = {"orientations": pxr.Vt.QuatfArray, "opacities": pxr.Vt.FloatArray}
    return kinds.get(name, pxr.Vt.Vec3fArray).FromNumpy(table)
