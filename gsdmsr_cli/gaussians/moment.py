"""What an engine draws: splats, and with them covariances in another form, and features."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats


@dataclass(frozen=True, eq=False)
class Moment:
    """N splats as they are at one moment.

    Attributes:
        splats: what is drawn.
        axes: (N, 3, 3) matrices A [world units]: the covariances are A A^T, and the quats and
            log_scales of the splats are not read. None if those hold.
        features: (N, F) with F >= 1, blended as colours are, sum of weight times feature, without
            a background or bounds. None if there are none.
        canonical_quats: (N, 4) the rotations that the motion was given, for layers that ask how
            splats have turned; not drawn. None unless a layer ``needs_turns``.
    """

    splats: Splats
    axes: Tensor | None = None
    features: Tensor | None = None
    canonical_quats: Tensor | None = None

    def __post_init__(self) -> None:
        if self.axes is not None and tuple(self.axes.shape) != (len(self), 3, 3):
            raise ValueError(f"axes has shape {tuple(self.axes.shape)}, not ({len(self)}, 3, 3)")
        if self.features is not None:
            shape = tuple(self.features.shape)
            if len(shape) != 2 or shape[0] != len(self) or shape[1] < 1:
                raise ValueError(f"features has shape {shape}, not ({len(self)}, F) with F >= 1")

    def __len__(self) -> int:
        return len(self.splats)

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors that a drawing depends on, by name."""
        found = self.splats.tensors()
        if self.axes is not None:
            del found["quats"], found["log_scales"]
            found["axes"] = self.axes
        return found if self.features is None else found | {"features": self.features}

    def map(self, function: Callable[[Tensor], Tensor]) -> Moment:
        """Return the moment with ``function`` applied to every tensor, also to those not read."""
        given = self.axes, self.features, self.canonical_quats
        further = (None if t is None else function(t) for t in given)
        return Moment(self.splats.map(function), *further)

    def take(self, rows: Tensor) -> Moment:
        """Return the moment whose row i is the parent's row ``rows[i]``; rows is (M,) int64."""
        return self.map(lambda tensor: tensor[rows])

    def detach(self) -> Moment:
        """Return the same values outside the autograd graph."""
        return self.map(Tensor.detach)
