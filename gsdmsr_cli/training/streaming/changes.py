"""Finds where the pictures of a moment differ from those of the moment before.

Scale-GS (Yang et al. 2025) masks both ways: what has not changed is not looked at, and cameras that
see little of what has are looked through less often. There the difference of the pictures is taken
back to anchors in space; here what the pictures do not show has no gradient, so that splats which
are seen nowhere else stay where they are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d

from gsdmsr_cli.ground.splatting_constants import TILE
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.pictures import HalvedPictures, Pictures
from gsdmsr_cli.scene.scene import View

BLOCK = 4
"""Side of the blocks over which differences are averaged [px]: noise of single pixels is none."""

LEAST_SHARE = 0.25
"""How often a camera that sees nothing change is looked through, in units of the one that sees the
most."""

UNCHANGED = 0.125
"""Probability with which a tile that has not changed is looked at all the same in a step, so that
nothing that has gone astray stays so."""


def changed_tiles(before: Tensor, now: Tensor, least: float) -> Tensor:
    """Return which tiles of a picture differ from an earlier one, or lie beside one that does.

    Args:
        before, now: (3, H, W) uint8.
        least: mean absolute difference of a block of ``BLOCK`` x ``BLOCK`` pixels from which on it
            counts [range of colours].

    Returns:
        (tiles,) bool, numbered as ``tile_grid`` has it.
    """
    difference = (now.float() - before.float()).abs().mean(dim=0)[None, None] / 255
    options = {"ceil_mode": True, "count_include_pad": False}
    blocks = avg_pool2d(difference, BLOCK, **options)
    tiles = max_pool2d(blocks, TILE // BLOCK, ceil_mode=True) >= least
    beside = max_pool2d(tiles.float(), 3, stride=1, padding=1)
    return beside[0, 0].flatten() > 0


class Changes:
    """What has changed in each view of the present moment.

    Args:
        least: see ``changed_tiles``; 0 where everything is looked at.
        views: the train views.
        pictures: of them; perhaps of half the size at first, which ``weights`` is told.
    """

    def __init__(self, least: float, views: Sequence[View], pictures: Pictures) -> None:
        self.least, self._views, self._pictures = least, views, pictures
        self._before: Mapping[int, int] = {}
        self._known: dict[tuple[int, int], Tensor] = {}

    def __bool__(self) -> bool:
        return self.least > 0

    def begin(self, rows: Sequence[int], before: Sequence[int]) -> None:
        """Begin a moment.

        Args:
            rows: of its views.
            before: of the views of the moment before, none at the first. A camera that has not
                moved is found again there.
        """
        cameras = {_placed(self._views[row].camera): row for row in before}
        places = {row: cameras.get(_placed(self._views[row].camera)) for row in rows}
        self._before = {row: found for row, found in places.items() if found is not None}
        self._known = {}

    def tiles(self, row: int, pictures: Pictures | HalvedPictures | None = None) -> Tensor | None:
        """Return which tiles of a view have changed, (tiles,) bool; None where nobody knows.

        Raises:
            DataError: a picture cannot be read.
        """
        if row not in self._before:
            return None
        source = pictures or self._pictures
        view, earlier = self._views[row], self._views[self._before[row]]
        key = row, source.camera(view).width
        if key not in self._known:
            found = changed_tiles(source.load(earlier), source.load(view), self.least)
            self._known[key] = found
        return self._known[key]

    def weights(
        self, row: int, pictures: Pictures | HalvedPictures, generator: torch.Generator
    ) -> Tensor | None:
        """Return the weight of each tile of a view in a step, (tiles,) float32, or None for 1."""
        tiles = self.tiles(row, pictures)
        if tiles is None:
            return None
        seen = torch.rand(len(tiles), generator=generator) < UNCHANGED
        return (tiles | seen).float()

    def wants(self, row: int, rows: Sequence[int], generator: torch.Generator) -> bool:
        """Return whether a view is to be seen now, at random, rather than the next one.

        Args:
            row: of the view.
            rows: of all views of the moment.
            generator: source of random choices.
        """
        if row not in self._before:
            return True
        most = max(map(self._share, rows))
        wanted = self._share(row) / most if most > 0 else 1.0
        return float(torch.rand((), generator=generator)) < max(wanted, LEAST_SHARE)

    def _share(self, row: int) -> float:
        """Return which share of a view has changed, whatever size its pictures have by now."""
        tiles = self.tiles(row)
        return 1.0 if tiles is None else float(tiles.float().mean())


def _placed(camera: Camera) -> tuple[bytes, float, float]:
    """Return what two pictures of one camera that has not moved share."""
    return camera.world_to_camera.tobytes(), camera.fx, camera.cx
