"""Everything that is drawn of one frame, before it is made into pictures."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from gsdmsr_cli.camera import Camera
from gsdmsr_cli.evaluation.protocol import Studio
from gsdmsr_cli.film import Shot
from gsdmsr_cli.flow import draw_flow
from gsdmsr_cli.imaging import resize_area
from gsdmsr_cli.splats import Splats
from gsdmsr_cli.splatting_constants import ALPHA_MIN

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Layers:
    """What is drawn of one frame of H x W pixels.

    Attributes:
        rgb: (H, W, 3) colour over the background, unclamped.
        alpha: (H, W) accumulated opacity.
        depth: (H, W) blended camera z, see ``Frame``; None if not drawn.
        flow: (H, W, 2) displacement until the next frame [px]; None if not drawn.
    """

    rgb: Floats
    alpha: Floats
    depth: Floats | None = None
    flow: Floats | None = None

    @property
    def expected_depth(self) -> Floats:
        """(H, W) depth of what is seen [world units], infinity where nothing is."""
        assert self.depth is not None
        seen = self.alpha > ALPHA_MIN
        return np.divide(self.depth, self.alpha, out=np.full_like(self.alpha, np.inf), where=seen)

    def shrunk(self, factor: int) -> Layers:
        """Return the layers with every pixel the mean of ``factor`` squared ones."""
        if factor == 1:
            return self
        flow = None if self.flow is None else _shrunk(self.flow, factor) / np.float32(factor)
        depth = None if self.depth is None else _shrunk(self.depth, factor)
        return Layers(_shrunk(self.rgb, factor), _shrunk(self.alpha, factor), depth, flow)


class Artist:
    """Draws the layers of one frame after another; keeps the splats of the next one.

    Args:
        studio: what is drawn, and what draws it.
        supersample: layers have so many times the pixels of a shot on each side.
        outputs: names of the outputs that are to be made of the layers.
    """

    def __init__(self, studio: Studio, supersample: int, outputs: Collection[str]) -> None:
        self._studio = studio
        self._supersample = supersample
        self._with_depth = "depth" in outputs
        self._with_flow = "flow" in outputs
        self._kept: tuple[float, Splats] | None = None

    @torch.no_grad()
    def draw(self, shot: Shot, following: Shot | None) -> Layers:
        """Draw a shot; without a ``following`` one there is no flow."""
        studio, camera = self._studio, self._camera(shot)
        splats = self._splats(shot.time)
        frame = studio.engine.rasterize(splats, camera, studio.background, None, self._with_depth)
        flow = None
        if self._with_flow and following is not None:
            later = self._splats(following.time)
            flow = draw_flow(splats, camera, later, self._camera(following), studio.engine)
        depth = None if frame.depth is None else frame.depth.numpy(force=True)
        moved = None if flow is None else flow.numpy(force=True)
        return Layers(frame.rgb.numpy(force=True), frame.alpha.numpy(force=True), depth, moved)

    def _camera(self, shot: Shot) -> Camera:
        camera, factor = shot.camera, self._supersample
        return camera.resized(camera.width * factor, camera.height * factor)

    def _splats(self, time: float) -> Splats:
        if self._kept is None or self._kept[0] != time:
            self._kept = time, self._studio.model.at(time)
        return self._kept[1]


def _shrunk(layer: Floats, factor: int) -> Floats:
    height, width = layer.shape[0] // factor, layer.shape[1] // factor
    return resize_area(np.ascontiguousarray(layer), width, height)
