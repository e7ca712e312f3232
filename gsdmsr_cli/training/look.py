"""One look at one view: draw it, compare it with its picture, take the gradients."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from gsdmsr_cli.camera import Camera
from gsdmsr_cli.model import Model
from gsdmsr_cli.pictures import HalvedPictures, Pictures
from gsdmsr_cli.preset import BACKGROUNDS, Preset
from gsdmsr_cli.raster import Comparing, Engine
from gsdmsr_cli.scene import View
from gsdmsr_cli.splats import Splats
from gsdmsr_cli.training.losses import photometric_loss


@dataclass(frozen=True, eq=False)
class Look:
    """What one view has to say.

    Attributes:
        loss: of the view.
        gradients: of the loss by every tensor of the model, None where it has no part.
        on_screen: (N, 2) by the positions on the screen [1 / px].
        size: width and height of the picture [px].
    """

    loss: float
    gradients: Sequence[Tensor | None]
    on_screen: Tensor
    size: tuple[int, int]


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
        progress: float,
        moving: bool,
        teachers: Tensor | None = None,
    ) -> Look:
        """Return what the view says of the model at a progress in [0, 1].

        Args:
            moving: whether the splats move yet.
            teachers: see ``Model.at``.

        Raises:
            DataError: the view's picture cannot be read.
        """
        low = progress < self.preset.training.low_resolution_until
        pictures = self._halved if low else self.pictures
        camera = pictures.camera(view)
        losses = self.preset.losses
        ssim_weight = losses.ssim if progress < losses.ssim_until else 0.0
        target, degree = pictures.load(view), self._sh_degree(progress)
        splats = model.at(view.time, teachers) if moving else model.splats
        loss, gradients, on_screen = compare(
            self.engine, model, splats, camera, self.background, target, ssim_weight, degree
        )
        return Look(loss, gradients, on_screen, (camera.width, camera.height))

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
) -> tuple[float, Sequence[Tensor | None], Tensor]:
    """Draw the model's splats and compare the picture with a target.

    Args:
        engine: what draws.
        model: whose tensors the gradients are taken by.
        splats: the model's, at the moment of the target or unmoved.
        camera, background, sh_degree: see ``Engine.rasterize``.
        target, ssim_weight: see ``photometric_loss``.

    Returns:
        the loss, its gradients by every tensor of the model (None where it has no part), and its
        gradient by the positions on the screen, (N, 2) [1 / px].
    """
    tensors = list(model.tensors().values())
    gradients: Sequence[Tensor | None]
    if isinstance(engine, Comparing):
        loss, on_screen = engine.compare(splats, camera, background, target, ssim_weight, sh_degree)
        gradients = torch.autograd.grad(loss, tensors, allow_unused=True)
    else:
        frame = engine.rasterize(splats, camera, background, sh_degree)
        loss = photometric_loss(frame.rgb, target, ssim_weight)
        wanted = [*tensors, frame.means2d]
        *gradients, on_screen = torch.autograd.grad(loss, wanted, allow_unused=True)
    return loss.item(), gradients, on_screen
