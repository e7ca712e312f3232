"""Draws a picture of a model; every command that needs one calls this.

Training wants gradients and no picture; see ``training.gradients``.
"""

from __future__ import annotations

from torch import Tensor

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.scene.camera import Camera


def draw(
    model: Model,
    camera: Camera,
    time: float | None,
    engine: Engine,
    background: Tensor,
    sh_degree: int | None = None,
    with_depth: bool = False,
    of_capture: bool = False,
) -> Frame:
    """Draw the model under a camera at a time in [0, 1], or unmoved if the time is None.

    Args:
        model: canonical splats and motion.
        camera: gives the picture's size.
        time: the moment, or None for the canonical splats.
        engine: see ``gsdmsr_cli.raster``.
        background: (3,) colour behind the splats.
        sh_degree: highest degree of colour to use, all by default.
        with_depth: also blend the camera's z.
        of_capture: whether the camera and the time are those of a view of the scene, for which
            layers may know more of it, see ``Model.instant_of_view``.
    """
    if time is None:
        return engine.rasterize(Moment(model.splats), camera, background, sh_degree, with_depth)
    if of_capture:
        instant, camera = model.instant_of_view(time, camera)
    else:
        instant = model.instant(time, camera)
    moment = model.at(instant)
    return draw_moment(model, moment, instant, camera, engine, background, sh_degree, with_depth)


def draw_moment(
    model: Model,
    moment: Moment,
    instant: Instant,
    camera: Camera,
    engine: Engine,
    background: Tensor,
    sh_degree: int | None = None,
    with_depth: bool = False,
) -> Frame:
    """Draw ``model.at(instant)``; other arguments as in ``draw``."""
    frame = engine.rasterize(moment, camera, background, sh_degree, with_depth)
    return model.shade(frame, instant)
