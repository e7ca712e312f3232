"""A view that a training does not see, drawn beside its truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.drawing.splatting import draw
from gsdmsr_cli.evaluation.metrics import quantize
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.scene.native import cv2
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import View


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A view, and what draws it.

    Attributes:
        view: which one.
        pictures: that have its truth, in the size of the training.
        engine: what draws.
        background: (3,) colour behind the splats.
    """

    view: View
    pictures: Pictures
    engine: Engine
    background: Tensor

    def truth(self) -> bytes:
        """Return the true picture as PNG.

        Raises:
            DataError: it cannot be read.
        """
        return _png(self.pictures.load(self.view).permute(1, 2, 0))

    @torch.no_grad()
    def drawn(self, model: Model) -> bytes:
        """Return the view of a model as PNG."""
        camera = self.pictures.camera(self.view)
        given = model, camera, self.view.time, self.engine, self.background
        frame = draw(*given, of_capture=True)
        return _png((255 * quantize(frame.rgb)).round().to(torch.uint8))


def _png(picture: Tensor) -> bytes:
    """Return (H, W, 3) uint8 as PNG."""
    done, data = cv2.imencode(".png", np.ascontiguousarray(picture.numpy()[..., ::-1]))
    if not done:
        raise DataError("a picture cannot be shown")
    return bytes(data)
