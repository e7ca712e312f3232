"""Draws a picture of a model; every command that needs one calls this.

Training wants gradients and no picture; see ``training.gradients``.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.model.model import Model, Share
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
    return draw_shown(show(model, instant), camera, engine, background, sh_degree, with_depth)


Shown = Sequence[tuple[Share, Moment]]
"""What is drawn at an instant: models that have part in the picture, and their splats."""


def show(model: Model, instant: Instant) -> Shown:
    """Return what is drawn of a model at an instant."""
    return [
        (share, share.model.as_seen(share.model.at(share.instant), share.instant))
        for share in model.shares(instant)
    ]


def draw_shown(
    shown: Shown,
    camera: Camera,
    engine: Engine,
    background: Tensor,
    sh_degree: int | None = None,
    with_depth: bool = False,
) -> Frame:
    """Draw what ``show`` returns; other arguments as in ``draw``."""
    frames = []
    for share, moment in shown:
        frame = engine.rasterize(moment, camera, background, sh_degree, with_depth)
        frames.append((share.weight, share.model.shade(frame, share.instant)))
    return frames[0][1] if len(frames) == 1 else _mean(frames)


def _mean(frames: Sequence[tuple[float, Frame]]) -> Frame:
    """Return the mean, by weights that add up to 1, of pictures of different splats."""
    weights, drawn = zip(*frames, strict=True)

    def mean(images: Sequence[Tensor]) -> Tensor:
        weighted = [weight * image for weight, image in zip(weights, images, strict=True)]
        return torch.stack(weighted).sum(dim=0)

    depths = [frame.depth for frame in drawn if frame.depth is not None]
    features = [frame.features for frame in drawn if frame.features is not None]
    return Frame(
        rgb=mean([frame.rgb for frame in drawn]),
        alpha=mean([frame.alpha for frame in drawn]),
        depth=mean(depths) if depths else None,
        radii=torch.cat([frame.radii for frame in drawn]),
        means2d=torch.cat([frame.means2d for frame in drawn]),
        features=mean(features) if features else None,
    )
