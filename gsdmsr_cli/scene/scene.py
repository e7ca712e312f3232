"""A captured scene: views with cameras and times, and the points to start from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene import picture_hashes
from gsdmsr_cli.scene.camera import Camera
from gsdmsr_cli.scene.lens import Lens
from gsdmsr_cli.scene.picture_hashes import Hashes

SPLITS = ("train", "val", "test")

MASK, MOVING = "mask", "moving"
"""Names of signals: pictures that are white where pixels count, and where the scene moves."""


@dataclass(frozen=True, eq=False)
class View:
    """One picture of the scene; its image file is decoded only when asked for.

    Attributes:
        name: unique name within its split, for reports.
        camera: camera at the full resolution of the file; a pinhole, where there is a ``lens``
            that which its undistorted picture has.
        time: moment in [0, 1].
        split: "train", "val" or "test".
        image_path: the picture, RGB or RGBA with straight alpha, or grey.
        signals: files of what else is known of the picture, by the names of signals; decoded, like
            the picture, only when asked for.
        lens: what the files were recorded through, the masks as well; None for a pinhole.
    """

    name: str
    camera: Camera
    time: float
    split: str
    image_path: Path
    signals: Mapping[str, Path] = field(default_factory=dict)
    lens: Lens | None = None


@dataclass(frozen=True, eq=False)
class Scene:
    """All views of one capture.

    Attributes:
        root: the folder it was read from.
        layout: name of the format it was read with.
        views: every view of every split, in file order.
        points: (P, 3) float32 initial points [world units]; P may be 0.
        colours: (P, 3) float32 colours of the points in [0, 1], or None where the format has none.
        duration: length of the capture [s], or None where the format does not say.
        bound: half edge of the box around the world's origin that holds what is to be
            reconstructed [world units], from the format's convention or the points.
        fingerprint: hash of the layout files, to tell two data sets apart; ``pictures`` does so for
            the files of the views.
        origin: what ``gsdmsr prepare`` made it from, such as the name of another layout; None where
            it is as it was published.
        decoded: where files of views lie that are not in ``root``, under the names that they would
            have there; None if they are all in it.
    """

    root: Path
    layout: str
    views: tuple[View, ...]
    points: NDArray[np.float32]
    colours: NDArray[np.float32] | None
    duration: float | None
    bound: float
    fingerprint: str
    origin: str | None = None
    decoded: Path | None = None

    @property
    def files(self) -> list[Path]:
        """The files of all views, pictures and signals, each once."""
        found = (path for view in self.views for path in (view.image_path, *view.signals.values()))
        return list(dict.fromkeys(found))

    @cached_property
    def pictures(self) -> Hashes:
        """Hashes of samples of the files of all views; they are read at the first call.

        Raises:
            DataError: one cannot be read.
        """
        return picture_hashes.sampled(self.root, self.files, self.decoded)

    def split(self, name: str) -> tuple[View, ...]:
        """Return the views of one split.

        Raises:
            DataError: the split has no views.
        """
        views = tuple(view for view in self.views if view.split == name)
        if not views:
            counts = {split: sum(v.split == split for v in self.views) for split in SPLITS}
            found = ", ".join(f"{split} {count}" for split, count in counts.items() if count)
            raise DataError(
                f"{self.root}: split '{name}' has no frames; found {found or 'none at all'}"
            )
        return views

    @cached_property
    def radius(self) -> float:
        """Extent of the train cameras: 1.1 times the largest distance to their mean (3DGS).

        But at least ``bound``: cameras that hardly move may well show something large.
        """
        centres = np.stack([view.camera.centre for view in self.split("train")])
        spread = np.linalg.norm(centres - centres.mean(0), axis=1).max()
        return max(float(1.1 * spread), self.bound)

    @property
    def train_times(self) -> list[float]:
        """Distinct times of the train views, ascending."""
        return sorted({view.time for view in self.split("train")})
