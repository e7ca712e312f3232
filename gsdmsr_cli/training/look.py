"""One look at one view: draw it, compare it with its picture, take the gradients."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gsdmsr_cli.camera import Camera
from gsdmsr_cli.model import Model
from gsdmsr_cli.pictures import HalvedPictures, Pictures
from gsdmsr_cli.preset import BACKGROUNDS, Preset
from gsdmsr_cli.raster import Comparing, Comparison, Engine
from gsdmsr_cli.scene import View
from gsdmsr_cli.splats import Splats
from gsdmsr_cli.splatting_constants import tile_grid
from gsdmsr_cli.training.losses import photometric_loss, tile_errors


class Stage(NamedTuple):
    """How far a training has come, for whoever looks at a view.

    Attributes:
        progress: in [0, 1].
        moving: whether the splats move yet.
        teachers: (N,) bool, who teaches the motion, see ``Model.at``.
    """

    progress: float
    moving: bool
    teachers: Tensor | None = None


@dataclass(frozen=True, eq=False)
class Look:
    """What one view has to say.

    Attributes:
        loss: of the view.
        gradients: of the loss by every tensor of the model, None where it has no part.
        on_screen: (N, 2) by the positions on the screen [1 / px].
        size: width and height of the picture [px].
        errors: of each tile, see ``raster.Comparison``.
    """

    loss: float
    gradients: Sequence[Tensor | None]
    on_screen: Tensor
    size: tuple[int, int]
    errors: Tensor | None = None


class Observer:
    """Looks at views as the preset wants it at each stage of a training.

    Attributes:
        background: (3,) colour behind the splats.
    """

    def __init__(self, preset: Preset, engine: Engine, pictures: Pictures) -> None:
        self.preset, self.engine, self.pictures = preset, engine, pictures
        self.background = torch.tensor(BACKGROUNDS[preset.data.background])
        self._halved = HalvedPictures(pictures)

    def look(
        self,
        model: Model,
        view: View,
        stage: Stage,
        tile_weights: Tensor | None = None,
    ) -> Look:
        """Return what the view says of the model.

        Args:
            stage: of the training.
            tile_weights: see ``compare``; only where ``tiles`` allows it.

        Raises:
            DataError: the view's picture cannot be read.
        """
        pictures = self._pictures(stage.progress)
        camera = pictures.camera(view)
        target, degree = pictures.load(view), self._sh_degree(stage.progress)
        splats = model.at(view.time, stage.teachers) if stage.moving else model.splats
        return compare(
            self.engine, model, splats, camera, self.background, target,
            self._ssim_weight(stage.progress), degree, tile_weights, pictures.counted(view),
        )  # fmt: skip

    def tiles(self, view: View, progress: float) -> int:
        """Return how many tiles a view's picture has, or 0 where they may not be chosen."""
        if self._ssim_weight(progress) > 0:
            return 0
        camera = self._pictures(progress).camera(view)
        return math.prod(tile_grid(camera.width, camera.height))

    def _pictures(self, progress: float) -> Pictures | HalvedPictures:
        low = progress < self.preset.training.low_resolution_until
        return self._halved if low else self.pictures

    def _ssim_weight(self, progress: float) -> float:
        losses = self.preset.losses
        return losses.ssim if progress < losses.ssim_until else 0.0

    def _sh_degree(self, progress: float) -> int:
        """Return the degree of colour; degree d joins at d times ``sh_start``."""
        options = self.preset.splats
        if options.sh_start <= 0:
            return options.sh_degree
        return min(options.sh_degree, int(progress / options.sh_start))


def compare(
    engine: Engine,
    model: Model,
    splats: Splats,
    camera: Camera,
    background: Tensor,
    target: Tensor,
    ssim_weight: float,
    sh_degree: int | None = None,
    tile_weights: Tensor | None = None,
    counted: Tensor | None = None,
) -> Look:
    """Draw the model's splats and compare the picture with a target.

    Args:
        engine: what draws.
        model: whose tensors the gradients are taken by.
        splats: the model's, at the moment of the target or unmoved.
        camera, background, sh_degree: see ``Engine.rasterize``.
        target, ssim_weight: see ``photometric_loss``.
        tile_weights: (tiles,) factors on the share of each tile in the loss, or None for 1
            everywhere; only where SSIM has no weight.
        counted: (H, W) bool, pixels that have a part in the loss, or None for all.
    """
    given = splats, camera, background, target, ssim_weight, sh_degree, tile_weights
    if counted is None and isinstance(engine, Comparing):
        found = engine.compare(*given)
    else:
        found = draw_and_compare(engine, *given, counted)
    tensors = list(model.tensors().values())
    gradients = torch.autograd.grad(found.loss, tensors, allow_unused=True)
    size = camera.width, camera.height
    return Look(found.loss.item(), gradients, found.on_screen, size, found.errors)


def draw_and_compare(
    engine: Engine,
    splats: Splats,
    camera: Camera,
    background: Tensor,
    target: Tensor,
    ssim_weight: float,
    sh_degree: int | None = None,
    tile_weights: Tensor | None = None,
    counted: Tensor | None = None,
) -> Comparison:
    """Do what ``Engine.compare`` does with an engine that can only draw.

    Pixels that do not count are taken for right, also by the windows of SSIM.
    """
    frame = engine.rasterize(splats, camera, background, sh_degree)
    rgb = frame.rgb
    if counted is not None:
        true = target.permute(1, 2, 0).to(rgb) / 255
        rgb = torch.where(counted.to(rgb.device)[..., None], rgb, true)
    errors = None if ssim_weight > 0 else tile_errors(rgb, target)
    if errors is None or tile_weights is None:
        loss = unweighted = photometric_loss(rgb, target, ssim_weight)
    else:
        errors = errors * (tile_weights > 0)
        loss = ((errors * tile_weights).sum() / target.numel()).to(rgb.dtype)
        unweighted = errors.sum() / target.numel()
    (on_screen,) = torch.autograd.grad(unweighted, frame.means2d, retain_graph=True)
    return Comparison(loss, on_screen, None if errors is None else errors.detach())
