"""Sorts the train views of a rig by their moments, and says where cameras are missing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import median
from types import ModuleType

from gsdmsr_cli.ground import plugins
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.model import layers
from gsdmsr_cli.model import motion as motions
from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.scene.scene import Scene, View

LEAST = 2
"""Cameras that must see most of the moments: from one alone nothing is known of depth."""

_NAMED = 5
"""Moments with missing cameras that are named one by one."""


@dataclass(frozen=True)
class Shot:
    """What the train cameras see of one moment.

    Attributes:
        time: in [0, 1].
        rows: of the train views, in their order.
    """

    time: float
    rows: tuple[int, ...]


def shots_of(views: Sequence[View]) -> list[Shot]:
    """Return the moments of train views, in the order of their times."""
    times = sorted({view.time for view in views})
    rows: dict[float, list[int]] = {time: [] for time in times}
    for row, view in enumerate(views):
        rows[view.time].append(row)
    return [Shot(time, tuple(rows[time])) for time in times]


def check_options(preset: Preset) -> None:
    """Raise UsageError if options do not go together with a stream; no data is needed."""
    if not preset.stream.enabled:
        streamed = [one["name"] for one in preset.layers if _is_streamed(layers, one["name"])]
        if streamed:
            raise UsageError(
                f"layers has {streamed[0]}, which is learnt moment after moment; add --stream, or "
                "leave it out"
            )
        return
    motion, start = preset.motion["name"], preset.splats.sh_start
    if not _is_streamed(motions, motion):
        names = plugins.names(motions.__name__)
        known = ", ".join(name for name in names if _is_streamed(motions, name))
        raise UsageError(
            f"motion.name is {motion}, which is not learnt moment after moment; with --stream it "
            f"has to be one of {known}, as in --preset persistent"
        )
    if start > 0 and preset.splats.sh_degree > 0:
        raise UsageError(
            f"splats.sh_start is {start:g}; allowed with --stream: 0, since progress begins anew "
            "at each moment and colours would"
        )
    if preset.segments.several:
        raise UsageError(
            f"segments.count is {preset.segments.count}; allowed with --stream: 1, since a stream "
            "is cut into moments"
        )
    if preset.saliency.gate != "none":
        raise UsageError(f"saliency.gate is {preset.saliency.gate}; allowed with --stream: none")


def _is_streamed(package: ModuleType, name: str) -> bool:
    """Return whether a plug-in is learnt moment after moment, which its module says."""
    return bool(getattr(plugins.load(package.__name__, name), "STREAMED", False))


def check_scene(scene: Scene) -> list[str]:
    """Return sentences about moments that lack cameras.

    Raises:
        DataError: the scene has not been filmed by several cameras at once.
    """
    shots = shots_of(scene.split("train"))
    counts = [len(shot.rows) for shot in shots]
    if median(counts) < LEAST:
        raise DataError(
            f"{scene.root}: one camera sees each moment, and --stream needs {LEAST} or more at "
            "once; leave it out, so that all moments are trained together"
        )
    most = max(counts)
    short = [i for i, count in enumerate(counts) if count < most]
    told = [
        f"moment {i} (time {shots[i].time:.4g}) lacks {most - counts[i]} of {most} cameras; it is "
        "learnt from the others"
        for i in short[:_NAMED]
    ]
    if len(short) > _NAMED:
        told.append(f"{len(short) - _NAMED} more moments lack cameras")
    return told


def first_shot(scene: Scene) -> Scene:
    """Return the scene with the train views of its first moment alone."""
    first = scene.train_times[0]
    views = tuple(v for v in scene.views if v.split != "train" or v.time == first)
    return replace(scene, views=views)


def watched(scene: Scene, shot: Shot) -> View:
    """Return the view of a moment whose PSNR is told: of val, or of train where val has none."""
    held = [v for v in scene.views if v.split == "val" and v.time == shot.time]
    train = scene.split("train")
    seen = held or [train[row] for row in shot.rows]
    return seen[len(seen) // 2]
