"""What exports write of a model: its splats at a time, as they have been asked for."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from gsdmsr_cli.exports._asked import Asked
from gsdmsr_cli.exports._facts import Facts
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.gaussians.turning import turn_world
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.model.model import Model

AXES = {
    "z-up": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "y-up": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "opencv": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}
"""Rotations from a world with z up to one with y up and to one with y down, z ahead."""

_NOT_CARRIED = {
    "axes": "axes that stand in place of rotations and scales",
    "features": "features beside the colours",
}
"""What a moment of a model may have besides its splats, by the attribute that holds it."""


@dataclass(frozen=True, eq=False)
class Source:
    """A model as it is to be written.

    Attributes:
        model: what is written.
        asked: axes, units, harmonics and which splats.
        facts: of its scene.
        counts: of the splats at each time that has been asked for; grows.
        details: what a format has to tell of its files, plain JSON; grows.
    """

    model: Model
    asked: Asked
    facts: Facts
    counts: list[int] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)

    def at(self, time: float) -> Splats:
        """Return the splats at ``time`` in [0, 1] that are to be written, which may hold NaN."""
        splats = self.model.at(self.model.instant(time)).splats.detach()
        faint = splats.logit_opacities.sigmoid() < self.asked.min_opacity  # not so where it is NaN
        kept = splats.take(~faint) if bool(faint.any()) else splats
        cut = replace(kept, sh=kept.sh[:, : (kept.degree_up_to(self.asked.sh_degree) + 1) ** 2])
        self.counts.append(len(cut))
        axes, scale = self.asked.axes or "scene", self.asked.scale
        if axes in ("scene", "z-up") and scale == 1:
            return cut
        return turn_world(cut, self.rotation, scale)

    @property
    def rotation(self) -> torch.Tensor:
        """From the scene's directions to the file's, (3, 3) float64."""
        axes = AXES.get(self.asked.axes or "scene", AXES["z-up"])
        return torch.tensor(axes, dtype=torch.float64)

    @property
    def sh_degree(self) -> int:
        """The degree of the harmonics that are to be written."""
        return self.model.splats.degree_up_to(self.asked.sh_degree)

    def impossible_at(self, time: float, bakes: bool = False) -> list[str]:
        """Return what keeps the splats at ``time`` from being written at all, a phrase for each.

        ``bakes`` says that the format has rotations and scales of its own.
        """
        if self.model.needs_camera:
            return ["splats that depend on the camera"]
        return [] if bakes else self._beside(time, "axes")

    def lost_at(self, time: float) -> list[str]:
        """Return what is more to the model at ``time`` in [0, 1] than splats, a phrase for each."""
        lost = self._beside(time, "features")
        return [*lost, "colours that are made after drawing"] if self.model.shades else lost

    def _beside(self, time: float, name: str) -> list[str]:
        moment = self.model.at(self.model.instant(time))
        return [] if getattr(moment, name) is None else [_NOT_CARRIED[name]]


def as_float32(splats: Splats) -> Splats:
    """Return splats as float32 on the CPU, their quaternions of unit length."""
    splats = splats.map(lambda tensor: tensor.detach().cpu())
    return replace(splats, quats=_unit_quats(splats.quats)).map(torch.Tensor.float)


def as_written(splats: Splats, path: Path) -> Splats:
    """Return splats as float32 on the CPU, their quaternions of unit length.

    Raises:
        DataError: a splat holds NaN or infinity.
    """
    written = as_float32(splats)
    rows = torch.cat([t.flatten(1) for t in map(_as_rows, written.tensors().values())], dim=1)
    broken = int((~rows.isfinite()).any(dim=1).sum())
    if broken:
        raise DataError(
            f"{broken} of {len(splats)} splats hold NaN or infinite values; {path} is not written: "
            "export an earlier checkpoint or train again"
        )
    return written


def _as_rows(tensor: torch.Tensor) -> torch.Tensor:
    return tensor[:, None] if tensor.ndim == 1 else tensor


def _unit_quats(quats: torch.Tensor) -> torch.Tensor:
    """Return (N, 4) quaternions of unit length; zero turns nothing, like the identity."""
    wide = quats.double()
    length = wide.norm(dim=1, keepdim=True)
    return torch.where(length == 0, wide.new_tensor([1.0, 0.0, 0.0, 0.0]), wide / length)
