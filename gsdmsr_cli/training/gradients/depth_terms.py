"""Takes the gradients of terms about depth, which draw a frame of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import torch

from gsdmsr_cli.drawing.depth import draw_depth
from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.model.folding import mask_gradients
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.training.gradients.compare import gradients_of, sum_of
from gsdmsr_cli.training.gradients.phase import ViewGradients
from gsdmsr_cli.training.losses import Seen, Term


def add_depth_terms(
    found: ViewGradients,
    terms: Iterable[tuple[Term, float]],
    seen: Callable[[Moment, Camera, Frame], Seen],
    moment: Moment,
    camera: Camera,
    model: Model,
    engine: Engine,
) -> ViewGradients:
    """Return what is said of a view and its picture, with the terms added.

    The motion has no part in their gradients: as if what it adds to the canonical splats were
    constant.

    Args:
        found: of the picture.
        terms: ``of_depth``, and the factor of each.
        seen: makes what terms are given.
        moment: that was drawn; its graph is not needed.
        camera: that the picture was drawn by.
        model: whose stored splats get the gradients.
        engine: draws the depths.
    """
    nowhere = torch.zeros(len(moment), dtype=torch.bool, device=moment.splats.means.device)
    moment = mask_gradients(Moment(model.splats), moment.detach(), nowhere)
    loss = found.loss.new_zeros(())
    for term, weight in terms:
        width, height = (max(1, side // term.shrink) for side in found.size)
        smaller = camera.resized(width, height)
        frame = draw_depth(moment, smaller, engine)
        loss = loss + weight * term(seen(moment, smaller, frame))
    parts = zip(found.gradients, gradients_of(loss, model), strict=True)
    gradients = [sum_of(both) for both in parts]
    return replace(found, loss=found.loss + loss.detach(), gradients=gradients)
