"""Chooses a few tiles of a picture to train on, more often where the error has been large.

GS-DMSR's batch is "4 frames x 1024 rays"; what a splatting engine can draw by itself is not a ray
but a tile of 16 x 16 pixels, so 1024 rays are four tiles. Whatever tiles are chosen, the weighted
sum of their losses is, in the mean, the loss of the whole picture.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

EVENLY = 0.5
"""Share of the tiles that is chosen regardless of the error."""


class TileSampler:
    """What is known of the error of each tile of each view.

    Attributes:
        count: tiles to choose of each view; 0 is all.
        errors: by view, (tiles,) float64 sums of distances when the tile was last drawn,
            NaN before that.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self.errors: dict[int, Tensor] = {}

    def choose(self, view: int, tiles: int, generator: torch.Generator) -> Tensor:
        """Return the weight of each tile in the loss, (tiles,) float32, 0 where it is left out.

        Tiles are drawn with replacement; one that has been drawn c times of n with probability q
        has the weight c / (n q) (importance sampling), so that the expected weight of each is 1.
        """
        probabilities = self._probabilities(view, tiles)
        drawn = torch.multinomial(probabilities, self.count, replacement=True, generator=generator)
        counts = torch.bincount(drawn, minlength=tiles)
        return (counts / (self.count * probabilities)).float()

    def learn(self, view: int, weights: Tensor, errors: Tensor) -> None:
        """Note the errors (tiles,) of those tiles that were drawn with these weights."""
        known = self._known(view, len(weights))
        self.errors[view] = torch.where(weights > 0, errors, known)

    def _known(self, view: int, tiles: int) -> Tensor:
        """Return the errors so far; none are known of pictures of another size."""
        known = self.errors.get(view)
        if known is None or len(known) != tiles:
            return torch.full((tiles,), torch.nan, dtype=torch.float64)
        return known

    def _probabilities(self, view: int, tiles: int) -> Tensor:
        """Return the probabilities (tiles,) float64; a tile not seen yet counts as an average one.

        No tile's probability is below ``EVENLY`` of its even share, so that no weight is too large.
        """
        even = torch.full((tiles,), 1 / tiles, dtype=torch.float64)
        known = self._known(view, tiles)
        errors = torch.where(known.isnan(), known.nanmean(), known)
        total = errors.sum()
        if not total > 0:  # nothing is known, or nothing is wrong
            return even
        return EVENLY * even + (1 - EVENLY) * errors / total

    def tensors(self) -> dict[str, Tensor]:
        """Return the state by name."""
        return {str(view): errors for view, errors in self.errors.items()}

    def restore(self, tensors: Mapping[str, Tensor]) -> None:
        """Return to what ``tensors`` returned."""
        self.errors = {int(name): errors for name, errors in tensors.items()}
