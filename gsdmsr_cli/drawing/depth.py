"""Draws how far away what a pixel shows is, without its colours."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.scene.camera import Camera


def draw_depth(moment: Moment, camera: Camera, engine: Engine) -> Frame:
    """Return a frame whose alpha and depth are those of the moment.

    Depth is blended as if it were the splats' colour, once for the colours that the frame then
    lacks: with ``with_depth`` engines blend both. The frame's rgb is its depth, and its depth is
    what ``Frame`` says, differentiable by the moment.

    Args:
        moment: N splats.
        camera: gives the picture's size.
        engine: see ``gsdmsr_cli.raster``.
    """
    means = moment.splats.means
    depths = depths_of(means, camera)
    # colours are harmonics plus 0.5; what lies behind the camera, below 0, is not drawn
    as_colour = ((depths - 0.5) / SH_C0)[:, None, None].expand(-1, 1, 3)
    coloured = replace(moment.splats, sh=as_colour)
    frame = engine.rasterize(Moment(coloured, moment.axes), camera, means.new_zeros(3))
    return replace(frame, depth=frame.rgb[..., 0])


def depths_of(points: Tensor, camera: Camera) -> Tensor:
    """Return the camera's z of points (N, 3), (N,) [world units]; below 0 behind it."""
    axis = torch.from_numpy(camera.rotation[2].copy()).to(points)
    return points @ axis + float(camera.translation[2])
