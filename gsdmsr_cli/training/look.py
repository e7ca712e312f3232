"""A look at views: draw them, compare them with their pictures, take the gradients."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from gsdmsr_cli.camera import Camera
from gsdmsr_cli.model import Model
from gsdmsr_cli.pictures import HalvedPictures, Pictures, ResidentPictures
from gsdmsr_cli.preset import BACKGROUNDS, Preset
from gsdmsr_cli.raster import Comparing, ComparingViews, Comparison, Engine
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
        loss: () of the view, outside the graph.
        gradients: of the loss by every tensor of the model, None where it has no part. Of views
            that were looked at together the first has the sum, the others have none.
        on_screen: (N, 2) by the positions on the screen [1 / px].
        size: width and height of the picture [px].
        errors: of each tile, see ``raster.Comparison``.
    """

    loss: Tensor
    gradients: Sequence[Tensor | None]
    on_screen: Tensor
    size: tuple[int, int]
    errors: Tensor | None = None


class Observer:
    """Looks at views as the preset wants it at each stage of a training.

    Attributes:
        background: (3,) colour behind the splats, on the device.
    """

    def __init__(
        self,
        preset: Preset,
        engine: Engine,
        pictures: Pictures,
        device: torch.device | str = "cpu",
    ) -> None:
        self.preset, self.engine, self.pictures = preset, engine, pictures
        self.background = torch.tensor(BACKGROUNDS[preset.data.background]).to(device)
        self._halved = HalvedPictures(pictures)
        self._resident = ResidentPictures(torch.device(device), preset.data.cache_mib << 20)

    def look(
        self,
        model: Model,
        views: Sequence[View],
        stage: Stage,
        tile_weights: Sequence[Tensor | None],
    ) -> list[Look]:
        """Return what each of the views says of the model.

        Args:
            model: what is looked at.
            views: at once, if the engine can and their pictures are of one size.
            stage: of the training.
            tile_weights: of each view, see ``compare``; only where ``tiles`` allows it.

        Raises:
            DataError: a view's picture cannot be read.
        """
        pictures = self._pictures(stage.progress)
        cameras = [pictures.camera(view) for view in views]
        targets = [self._resident.load(pictures, view) for view in views]
        masks = [pictures.counted(view) for view in views]
        times = [view.time for view in views]
        weights = [None if own is None else own.to(self.background.device) for own in tile_weights]
        further = self._ssim_weight(stage.progress), self._sh_degree(stage.progress)
        together = _alike(cameras, weights) and all(mask is None for mask in masks)
        if together and isinstance(self.engine, ComparingViews):
            given = self.engine, model, self._moved(model, times, stage), cameras
            return compare_views(*given, self.background, targets, *further, weights)
        looks = zip(times, cameras, targets, weights, masks, strict=True)
        return [
            compare(
                self.engine, model, self._moved(model, [time], stage)[0], camera, self.background,
                target, *further, own, mask,
            )
            for time, camera, target, own, mask in looks
        ]  # fmt: skip

    def _moved(self, model: Model, times: Sequence[float], stage: Stage) -> list[Splats]:
        """Return the splats at each of the times, the very same ones where times are equal."""
        if not stage.moving:
            return [model.splats] * len(times)
        distinct = list(dict.fromkeys(times))
        moved = dict(zip(distinct, model.at_times(distinct, stage.teachers), strict=True))
        return [moved[time] for time in times]

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
    return Look(found.loss.detach(), gradients, found.on_screen, size, found.errors)


def compare_views(
    engine: ComparingViews,
    model: Model,
    splats: Sequence[Splats],
    cameras: Sequence[Camera],
    background: Tensor,
    targets: Sequence[Tensor],
    ssim_weight: float,
    sh_degree: int | None,
    tile_weights: Sequence[Tensor | None],
) -> list[Look]:
    """Do what ``compare`` does of several views at once."""
    weights = [own for own in tile_weights if own is not None]
    loss, found = engine.compare_views(
        splats, cameras, background, targets, ssim_weight, sh_degree, weights or None
    )
    tensors = list(model.tensors().values())
    gradients = torch.autograd.grad(loss, tensors, allow_unused=True)
    nothing = [None] * len(tensors)
    return [
        Look(own.loss, nothing if i else gradients, own.on_screen, (c.width, c.height), own.errors)
        for i, (own, c) in enumerate(zip(found, cameras, strict=True))
    ]


def _alike(cameras: Sequence[Camera], tile_weights: Sequence[Tensor | None]) -> bool:
    """Tell whether views can be looked at together."""
    sizes = {(camera.width, camera.height) for camera in cameras}
    return len(sizes) == 1 and len({weights is None for weights in tile_weights}) == 1


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
