"""THE renderer: whoever wants a picture of a model draws it through here.

Training wants gradients and no picture; see ``training.look``.
"""

from __future__ import annotations

from torch import Tensor

from gsdmsr_cli.camera import Camera
from gsdmsr_cli.frame import Frame
from gsdmsr_cli.model import Model
from gsdmsr_cli.raster import Engine


def draw(
    model: Model,
    camera: Camera,
    time: float | None,
    engine: Engine,
    background: Tensor,
    sh_degree: int | None = None,
    with_depth: bool = False,
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
    """
    splats = model.splats if time is None else model.at(time)
    return engine.rasterize(splats, camera, background, sh_degree, with_depth)
