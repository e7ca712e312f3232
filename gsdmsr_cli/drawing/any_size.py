"""Draws pictures of other sizes than those that a model was trained with as those look.

An engine adds a fixed variance to a splat's covariance on the screen, a low-pass for pixels of the
size that is drawn. Training takes it into account, so that it belongs to the pixels of training:
at twice the size splats would be thinner and leave gaps, at half the size they would be fatter,
and what is finer than a pixel would be missed or counted in full (Yu et al., Mip-Splatting, CVPR
2024, section 4). Pictures with more pixels are therefore drawn with the low-pass of training;
those with fewer are drawn as finely as in training, and each pixel is the mean of what it covers.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.splatting_constants import DILATION
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.scene.camera import Camera

SAME = 1.2
"""How many times larger or smaller pixels may be and still count as those of training. Focal
lengths that have been refined differ from those of the scene by less."""


def focal_of(camera: Camera) -> float:
    """Return how many pixels there are per unit of slope, the mean of both axes [px]."""
    return math.sqrt(camera.fx * camera.fy)


@dataclass(frozen=True)
class AnySize:
    """An engine that draws what a training has had with pixels of another size.

    Attributes:
        engine: what draws.
        coarsest, finest: least and largest focal length in training [px].
    """

    engine: Engine
    coarsest: float
    finest: float

    def unavailable(self, device: str) -> str | None:
        """Return why the engine cannot draw on ``device``, or None if it can."""
        return self.engine.unavailable(device)

    def rasterize(
        self,
        moment: Moment,
        camera: Camera,
        background: Tensor,
        sh_degree: int | None = None,
        with_depth: bool = False,
    ) -> Frame:
        """Draw the moment, see ``raster``; as the engine does at the sizes of training."""
        focal, given = focal_of(camera), (background, sh_degree, with_depth)
        if focal > self.finest * SAME:
            wider = _with_low_pass(moment, camera, DILATION * ((focal / self.finest) ** 2 - 1))
            return self.engine.rasterize(wider, camera, *given)
        if focal * SAME < self.coarsest:
            times = math.ceil(self.coarsest / focal / SAME)
            finer = camera.resized(camera.width * times, camera.height * times)
            return _mean_of_squares(self.engine.rasterize(moment, finer, *given), times)
        return self.engine.rasterize(moment, camera, *given)


def at_any_size(engine: Engine, focals: Sequence[float]) -> Engine:
    """Return an engine for what has been trained with these focal lengths [px], if any."""
    return AnySize(engine, min(focals), max(focals)) if focals else engine


def _with_low_pass(moment: Moment, camera: Camera, variance: float) -> Moment:
    """Return splats that are wider by a variance on the screen [px^2] where they are.

    By the same in all directions of space, which is the same on the screen but for perspective.
    """
    splats = moment.splats
    forward = torch.tensor(camera.rotation[2]).to(splats.means)
    depths = splats.means @ forward + float(camera.translation[2])
    added = variance * (depths / focal_of(camera)).square()
    if moment.axes is not None:
        unit = torch.eye(3).to(moment.axes)
        covariances = moment.axes @ moment.axes.mT + added[:, None, None] * unit
        roots, failed = torch.linalg.cholesky_ex(covariances)  # thin ones may be too thin for it
        return replace(moment, axes=torch.where((failed == 0)[:, None, None], roots, moment.axes))
    log_scales = 0.5 * torch.logaddexp(2 * splats.log_scales, added.log()[:, None])
    return replace(moment, splats=replace(splats, log_scales=log_scales))


def _mean_of_squares(frame: Frame, times: int) -> Frame:
    """Return the picture of which each pixel is the mean of ``times`` x ``times`` of a frame's."""

    def mean(image: Tensor) -> Tensor:
        height, width = image.shape[0] // times, image.shape[1] // times
        squares = image.unflatten(1, (width, times)).unflatten(0, (height, times))
        averaged: Tensor = squares.mean(dim=(1, 3))
        return averaged

    return Frame(
        rgb=mean(frame.rgb),
        alpha=mean(frame.alpha),
        depth=None if frame.depth is None else mean(frame.depth),
        radii=torch.ceil(frame.radii / times).to(frame.radii.dtype),
        means2d=frame.means2d / times,
        features=None if frame.features is None else mean(frame.features),
    )
