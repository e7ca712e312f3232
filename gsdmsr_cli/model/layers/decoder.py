"""Colours that a small network adds to what has been drawn, from features of the splats.

SpacetimeGaussians (STG; Li et al., CVPR 2024), section 4.2: every splat has nine features, three of
a base colour, three of direction and three of time, the last times t - mu, the time since the
splat's temporal centre. They are blended as colours are, and a network decodes each pixel:
C = base + network(direction, time, line of sight).

Here the base is the colour of the splats as it is drawn. The network sees it too, with the alpha of
the pixel, by which its output is multiplied: where nothing is, the background stays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.model.times import spread_times, take_known
from gsdmsr_cli.ops import network
from gsdmsr_cli.options.strict import require, require_rates
from gsdmsr_cli.scene.camera import Camera

INPUTS = 16
"""Base colour, features of direction and of time, alpha, origin and direction of the sight."""


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        width: of the network's hidden layer, 16 or 32.
        rate: learning rate of the features of direction at the start and the end.
        time_rate: that of the features of time.
    """

    width: int = 16
    rate: tuple[float, float] = (2.5e-3, 1e-3)
    time_rate: tuple[float, float] = (1e-3, 4e-4)

    def __post_init__(self) -> None:
        require(self, "width", self.width in (16, 32), "16 or 32")
        require_rates(self, "rate", "time_rate")


class Decoder(Layer):
    """Features of direction and time (N, 3) each, centres (N,) in time, and the network."""

    concerns_still = True
    needs_camera = True
    shades = True

    def __init__(
        self, options: Options, facts: Facts, splats: Splats, generator: torch.Generator
    ) -> None:
        self.bound = facts.bound
        self.centres = spread_times(len(splats))
        self.directions = (0.5 + SH_C0 * splats.sh[:, 0]).detach().clone()
        self.times = torch.zeros(len(splats), 3)
        self.layers = network.new_network([INPUTS, options.width, 3], generator)
        named = [
            Parameter(f"network.{i}.{field}", tensor, rate="network")
            for i, layer in enumerate(self.layers)
            for field, tensor in layer._asdict().items()
        ]
        super().__init__(
            [
                Parameter("centres", self.centres, per_splat=True),
                Parameter("directions", self.directions, per_splat=True, rate=options.rate),
                Parameter("times", self.times, per_splat=True, rate=options.time_rate),
                *named,
            ]
        )

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the splats with their features (N, 6) at the time."""
        since = (instant.time - self.centres)[:, None]
        return replace(moment, features=torch.cat([self.directions, since * self.times], dim=1))

    def shade(self, frame: Frame, instant: Instant) -> Frame:
        """Return the frame with the decoded colours; before the motion begins it has none.

        Raises:
            ValueError: the instant has no camera.
        """
        if frame.features is None:
            return frame
        if instant.camera is None:
            raise ValueError("colours that depend on the line of sight need a camera")
        rgb, pixels = _planes(frame.rgb), _covered(frame.alpha)
        planes = torch.cat([rgb, _planes(frame.features), frame.alpha.reshape(1, -1)])
        shown = planes.gather(1, pixels.expand(len(planes), -1))
        seen = torch.cat([shown, self._sights(instant.camera, pixels).to(rgb)])
        added = network.apply_network(self.layers, seen.T).T
        found = rgb.scatter_add(1, pixels.expand(3, -1), shown[-1] * added)
        return replace(frame, rgb=found.T.view(frame.rgb.shape))

    def _sights(self, camera: Camera, pixels: Tensor) -> Tensor:
        """Return where pixels (M,), by number, are seen from [bounds] and whereto, (6, M)."""
        x = (pixels % camera.width + 0.5 - camera.cx) / camera.fx
        y = (pixels // camera.width + 0.5 - camera.cy) / camera.fy
        spots = torch.stack([x, y, torch.ones_like(x)]) / torch.sqrt(x * x + y * y + 1)
        lines = torch.from_numpy(camera.rotation.T).to(spots) @ spots
        centre = torch.from_numpy(camera.centre / self.bound).to(lines)
        return torch.cat([centre[:, None].expand(3, len(pixels)), lines])

    def begin_at(self, times: Tensor) -> None:
        """Let features of time be about the times at which splats were seen."""
        take_known(self.centres, times)

    def check(self) -> None:
        """Raise ValueError unless the network fits."""
        network.check_network(self.layers, INPUTS, 3)


def _planes(picture: Tensor) -> Tensor:
    """Return (H, W, C) as (C, H W), which is how engines lay pictures out."""
    return picture.permute(2, 0, 1).flatten(1)


def _covered(alpha: Tensor) -> Tensor:
    """Return the numbers (M,) of the pixels that show anything; all on a GPU, which would wait."""
    if alpha.is_cpu:
        return alpha.flatten().nonzero().flatten()
    return torch.arange(alpha.numel(), device=alpha.device)


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Decoder:
    """Return a layer that adds nothing until its network's last layer has been trained."""
    return Decoder(options, facts, splats, generator)
