"""Renders one frame of a film: colour, opacity, depth and optical flow as float arrays."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from gsdmsr_cli.drawing.flow import draw_flow
from gsdmsr_cli.drawing.splatting import Shown, draw_shown, show
from gsdmsr_cli.evaluation.protocol import ViewRenderer
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.splatting_constants import ALPHA_MIN
from gsdmsr_cli.model.joined import Joined
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.film import Shot
from gsdmsr_cli.scene.imaging import resize_area

Floats = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Buffers:
    """The float arrays that are rendered for one frame of H x W pixels.

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

    def shrunk(self, factor: int) -> Buffers:
        """Return the buffers with every pixel the mean of ``factor`` squared ones."""
        if factor == 1:
            return self
        flow = None if self.flow is None else _shrunk(self.flow, factor) / np.float32(factor)
        depth = None if self.depth is None else _shrunk(self.depth, factor)
        return Buffers(_shrunk(self.rgb, factor), _shrunk(self.alpha, factor), depth, flow)


class BufferRenderer:
    """Renders the buffers of one frame after another; keeps the splats of the next frame for it.

    Args:
        renderer: the model, the engine and the background.
        supersample: factor by which buffers are larger than the shot on each side.
        outputs: names of the outputs that are to be made of the buffers.
    """

    def __init__(self, renderer: ViewRenderer, supersample: int, outputs: Collection[str]) -> None:
        self._renderer = renderer
        self._supersample = supersample
        self._with_depth = "depth" in outputs
        self._with_flow = "flow" in outputs
        self._kept: tuple[Instant, Shown] | None = None

    @torch.no_grad()
    def draw(self, shot: Shot, following: Shot | None) -> Buffers:
        """Draw a shot; without a ``following`` one there is no flow."""
        renderer = self._renderer
        instant, camera = self._seen(shot)
        shown = self._shown(instant)
        given = renderer.engine, renderer.background, None, self._with_depth
        frame = draw_shown(shown, camera, *given)
        flow = None
        if self._with_flow and following is not None:
            next_instant, next_camera = self._seen(following)
            now, later = self._pair(instant, next_instant)
            flow = draw_flow(now, camera, later, next_camera, renderer.engine)
        depth = None if frame.depth is None else frame.depth.numpy(force=True)
        moved = None if flow is None else flow.numpy(force=True)
        return Buffers(frame.rgb.numpy(force=True), frame.alpha.numpy(force=True), depth, moved)

    def _seen(self, shot: Shot) -> tuple[Instant, Camera]:
        """Return the instant and the camera of a shot, of a view's as layers know it."""
        model, factor = self._renderer.model, self._supersample
        camera = shot.camera.resized(shot.camera.width * factor, shot.camera.height * factor)
        if shot.view is not None:
            return model.instant_of_view(shot.time, camera)
        return model.instant(shot.time, camera), camera

    def _shown(self, instant: Instant) -> Shown:
        if self._kept is None or self._kept[0] != instant:
            self._kept = instant, show(self._renderer.model, instant)
        return self._kept[1]

    def _pair(self, instant: Instant, later: Instant) -> tuple[Moment, Moment]:
        """Return the same splats at two instants: of segments, those of the one that counts most.

        That one goes on to the later instant, or stops at its own end if that comes before.
        """
        model = self._renderer.model
        _, now = max(self._shown(instant), key=lambda one: one[0].weight)
        if isinstance(model, Joined):
            lead, own = model.lead(instant, later)
            return now, lead.at(own)
        return now, self._shown(later)[0][1]


def _shrunk(buffer: Floats, factor: int) -> Floats:
    height, width = buffer.shape[0] // factor, buffer.shape[1] // factor
    return resize_area(np.ascontiguousarray(buffer), width, height)
