"""Engines draw splats under a camera and give gradients; one file per engine.

An engine is a module of this package with two functions::

    def unavailable(device: str) -> str | None
        # None if the engine can draw tensors on the device, else the reason, one clause

    def rasterize(moment: Moment, camera: Camera, background: Tensor,
                  sh_degree: int | None = None, with_depth: bool = False) -> Frame
        # background is (3,); colours use the first (sh_degree + 1)^2 coefficients, all by default

and, if it can do both in one go faster than one after the other::

    def compare(moment: Moment, camera: Camera, background: Tensor, target: Tensor,
                measure: Measure, sh_degree: int | None = None,
                tile_weights: Tensor | None = None) -> Comparison
        # what ``ops.photometric.photometric_loss`` says of the drawn picture; without SSIM
        # also of some tiles of it, whose shares of the loss are multiplied by their weights;
        # ValueError if the moment has features, which are decoded before anything is compared

or the same of several views at once::

    def compare_views(moments: Sequence[Moment], cameras: Sequence[Camera], background: Tensor,
                      targets: Sequence[Tensor], measure: Measure, sh_degree: int | None = None,
                      tile_weights: Sequence[Tensor] | None = None,
                      ) -> tuple[Tensor, list[Comparison]]
        # the sum of the losses, and what is to be said of each view; all have one picture size

Gradients reach all tensors that are read (``Moment.tensors``); splats with a value that is not
finite are not drawn, and get the gradient zero. ``frame.means2d`` is part of the graph, so that
``frame.means2d.retain_grad()`` gives density control its statistic. Every engine is held to
``reference`` by tests/raster/test_conformance.py.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol, cast, runtime_checkable

from torch import Tensor

from gsdmsr_cli.gaussians.frame import Frame
from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground import plugins
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.measure import Measure
from gsdmsr_cli.scene.camera import Camera

FASTEST_FIRST = ("cuda", "cpu", "reference")


class Comparison(NamedTuple):
    """What an engine says of a picture that it has drawn and compared.

    Attributes:
        loss: of the picture.
        on_screen: (N, 2) gradient of the loss by the positions on the screen [1 / px], as if all
            tiles with a weight above 0 had the weight 1.
        errors: (tiles,) float64, the sum of distances in each tile, 0 where it has the weight
            0; None where SSIM counts.
    """

    loss: Tensor
    on_screen: Tensor
    errors: Tensor | None


class Engine(Protocol):
    """What a module of this package offers."""

    def unavailable(self, device: str) -> str | None:
        """Return why the engine cannot draw on ``device``, or None if it can."""

    def rasterize(
        self,
        moment: Moment,
        camera: Camera,
        background: Tensor,
        sh_degree: int | None = None,
        with_depth: bool = False,
    ) -> Frame:
        """Draw the moment."""


@runtime_checkable
class Comparing(Engine, Protocol):
    """An engine that draws and compares in one go."""

    def compare(
        self,
        moment: Moment,
        camera: Camera,
        background: Tensor,
        target: Tensor,
        measure: Measure,
        sh_degree: int | None = None,
        tile_weights: Tensor | None = None,
    ) -> Comparison:
        """Return what is to be said of the picture."""


@runtime_checkable
class ComparingViews(Engine, Protocol):
    """An engine that draws and compares several views in one go."""

    def compare_views(
        self,
        moments: Sequence[Moment],
        cameras: Sequence[Camera],
        background: Tensor,
        targets: Sequence[Tensor],
        measure: Measure,
        sh_degree: int | None = None,
        tile_weights: Sequence[Tensor] | None = None,
    ) -> tuple[Tensor, list[Comparison]]:
        """Return the sum of the losses, and what is to be said of each picture."""


def load_engine(name: str) -> Engine:
    """Import the engine ``name``.

    Raises:
        UsageError: there is no such engine.
    """
    return cast(Engine, plugins.load(__name__, name))


def engine_names() -> list[str]:
    """Return the names of all engines, the fastest first."""
    return [name for name in FASTEST_FIRST if name in plugins.names(__name__)]


def best_engine(device: str) -> Engine:
    """Return the fastest engine that can draw on ``device`` ("cpu" or "cuda").

    Raises:
        UsageError: none can; the message lists every engine's reason.
    """
    reasons = []
    for name in engine_names():
        engine = load_engine(name)
        reason = engine.unavailable(device)
        if reason is None:
            return engine
        reasons.append(f"{name}: {reason}")
    raise UsageError(f"no engine can draw on device '{device}' ({'; '.join(reasons)})")


def pick_device(wanted: str) -> str:
    """Return where to compute, "cpu" or "cuda"; "auto" takes the GPU if the engine can draw there.

    Raises:
        DataError: "cuda" is wanted, and the engine cannot draw there.
    """
    if wanted == "cpu":
        return wanted
    reason = load_engine("cuda").unavailable("cuda")
    if reason is not None and wanted == "cuda":
        raise DataError(f"--device cuda: {reason}; use --device cpu")
    return "cpu" if reason is not None else "cuda"
