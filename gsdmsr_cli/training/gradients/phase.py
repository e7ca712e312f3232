"""What goes to those who take a view's gradients, and what comes back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor


class Phase(NamedTuple):
    """How far a training has come, as rendering a view needs it.

    Attributes:
        progress: in [0, 1].
        moving: whether the splats move yet.
        gradient_mask: (N,) bool, the splats whose gradients reach layers, see ``Model.at``.
        frozen: whether the canonical splats stay as they are, as after a stream's first moment.
        screens: whether anybody asks for the gradients on the screen.
        step: how many steps have been made.
    """

    progress: float
    moving: bool
    gradient_mask: Tensor | None = None
    frozen: bool = False
    screens: bool = True
    step: int = 0


class Order(NamedTuple):
    """A view to render.

    Attributes:
        row: of the train views.
        tile_weights: (tiles,) factors on the loss of each tile, or None for the whole picture.
        jitter: see ``Instant``.
        other_times: of each term of the loss, the second time that it wants, or None.
        seed: of the random choices of terms of the loss; 0 where none makes any.
    """

    row: int
    tile_weights: Tensor | None = None
    jitter: float = 0.0
    other_times: tuple[float | None, ...] = ()
    seed: int = 0


@dataclass(frozen=True, eq=False)
class ViewGradients:
    """What rendering one view and going backward has given.

    Attributes:
        loss: () of the view, outside the graph.
        gradients: of the loss by every trained tensor of the model, None where it has no part. Of
            views that were rendered together the first has the sum, the others have none.
        on_screen: (N, 2) gradient of the photometric loss by the positions on the screen [1 / px];
            may be 0 where nobody asks for it.
        size: width and height of the picture [px].
        tile_errors: of each tile, see ``raster.Comparison``.
    """

    loss: Tensor
    gradients: Sequence[Tensor | None]
    on_screen: Tensor
    size: tuple[int, int]
    tile_errors: Tensor | None = None
