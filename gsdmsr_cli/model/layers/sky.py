"""What lies behind all splats: a colour for each direction, on the faces of a cube.

The sky of periodic vibration Gaussians (Chen et al. 2023, section 3.4): an environment map is added
to what has been drawn, as much as the splats let through. It begins as the plain background.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.model.layer import Facts, Instant, Layer
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.ops.cube_map import look, show_behind
from gsdmsr_cli.ops.cube_map.twin import BESIDE
from gsdmsr_cli.options.strict import require, require_rates


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        resolution: grid points along an edge of the cube, 2 or more.
        rate: learning rate of the colours at the start and the end.
    """

    resolution: int = 16
    rate: tuple[float, float] = (1e-2, 1e-3)

    def __post_init__(self) -> None:
        require(self, "resolution", self.resolution >= 2, "2 or more")
        require_rates(self, "rate")


class Sky(Layer):
    """Colours (M, 3) of the grid points on a cube's surface, less that of the background.

    Faces share the points of their edges, so that there are no seams.
    """

    concerns_still = True
    needs_camera = True
    shades = True

    def __init__(self, options: Options) -> None:
        self._points = grid_points(options.resolution)
        self.colours = torch.zeros(int(self._points.max()) + 1, 3)
        super().__init__([Parameter("colours", self.colours, rate=options.rate)])

    def at(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moment itself."""
        return moment

    def shade(self, frame: Frame, instant: Instant) -> Frame:
        """Return the frame with the sky behind it."""
        assert instant.camera is not None, "a layer that needs a camera is given one"
        given = frame.rgb, frame.alpha, self.colours, self._places()
        return replace(frame, rgb=show_behind(*given, instant.camera))

    def look(self, ways: Tensor) -> Tensor:
        """Return the colours in directions (..., 3) of any length but 0, linear between points."""
        return look(ways, self.colours, self._places())

    def _places(self) -> Tensor:
        self._points = self._points.to(self.colours.device)
        return self._points

    def check(self) -> None:
        """Raise ValueError unless the colours are those of the points of a cube."""
        count = len(self.colours)
        size = 1 + round(((count - 2) / 6) ** 0.5) if count > 2 else 0
        if size < 2 or 6 * (size - 1) ** 2 + 2 != count or self.colours.shape[1:] != (3,):
            raise ValueError(f"a sky of shape {tuple(self.colours.shape)}")
        self._points = grid_points(size)


def grid_points(size: int) -> Tensor:
    """Return which point of a cube's surface each of the points of its faces is, (6, size, size).

    Points at edges and corners belong to several faces. The faces are those at the lower and upper
    end of x, of y and of z, their rows and columns along the axes ``BESIDE``.
    """
    line = torch.arange(size)
    rows, columns = torch.meshgrid(line, line, indexing="ij")
    places = []
    for beside in BESIDE:
        for end in (0, size - 1):
            place = torch.full((size, size, 3), end)
            place[..., beside[0]], place[..., beside[1]] = rows, columns
            places.append(place)
    numbers = torch.stack(places) @ torch.tensor([size * size, size, 1])
    points: Tensor = torch.unique(numbers, return_inverse=True)[1]
    return points


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Sky:
    """Return a sky that is the background until it has been trained."""
    return Sky(options)
