"""Reads a camera path from a JSON file of keyframes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.files import read_json
from gsdmsr_cli.options import strict
from gsdmsr_cli.options.strict import require
from gsdmsr_cli.paths._around import common_up
from gsdmsr_cli.paths._smooth import Key, interpolate
from gsdmsr_cli.paths._views import find_view
from gsdmsr_cli.scene.camera import Camera, look_at
from gsdmsr_cli.scene.film import MADE_FPS, Film
from gsdmsr_cli.scene.scene import Scene

FRAMES = 120
MOST = 100_000
"""Frames of a film; more are a typing error."""

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Keyframe:
    """One keyframe as it is written.

    Attributes:
        time: the moment of the scene, in [0, 1].
        view: name of a view whose camera it is; or else the next two.
        position: (3,) of the camera [world units].
        look_at: (3,) what it faces [world units].
        up: (3,) towards the top of the picture; that of the train cameras if not given.
        field_of_view: of the picture's height [degrees]; that of the first train view if not given.
        at: when the film shows it [s from its beginning]; all keyframes have it, or none.
    """

    time: float
    view: str | None = None
    position: Point | None = None
    look_at: Point | None = None
    up: Point | None = None
    field_of_view: float | None = None
    at: float | None = None

    def __post_init__(self) -> None:
        require(self, "time", 0 <= self.time <= 1, "0 to 1, from the first moment to the last")
        own = (self.position, self.look_at, self.up, self.field_of_view)
        if self.view is not None:
            alone = all(value is None for value in own)
            allowed = "no 'view' beside 'position', 'look_at', 'up' and 'field_of_view'"
            require(self, "view", alone, allowed)
        else:
            needed = "three numbers, or a 'view' in its place"
            require(self, "position", self.position is not None, needed)
            require(self, "look_at", self.look_at is not None, needed)
            require(self, "look_at", self.look_at != self.position, "another point than 'position'")
        angle = self.field_of_view
        require(self, "field_of_view", angle is None or 0 < angle < 180, "more than 0, below 180")


@dataclass(frozen=True)
class Keyframes:
    """A file of keyframes as it is written.

    Attributes:
        keyframes: two or more, in order.
        frames: number of frames; ``FRAMES``, or what ``at`` and ``fps`` come to, if not given.
        fps: frames a second.
    """

    keyframes: tuple[Any, ...]
    frames: int | None = None
    fps: float | None = None

    def __post_init__(self) -> None:
        require(self, "keyframes", len(self.keyframes) >= 2, "a list of two or more")
        count = self.frames
        require(self, "frames", count is None or 1 <= count <= MOST, f"1 to {MOST}")
        require(self, "fps", self.fps is None or 0 < self.fps <= 1000, "more than 0, up to 1000")


def film(scene: Scene, path: Path, frames: int | None, fps: float | None) -> Film:
    """Return the film of a file; ``frames`` and ``fps`` take the place of the file's own.

    Raises:
        DataError: the file cannot be read, or a key is unknown, missing or out of range.
    """
    document = read_json(path)
    try:
        written = strict.build(Keyframes, document, str(path))
        items = [_keyframe(path, i, item) for i, item in enumerate(written.keyframes)]
        keys = [_key(scene, f"{path}: keyframes[{i}]", item) for i, item in enumerate(items)]
        knots = _knots(path, items)
    except UsageError as error:
        raise DataError(str(error)) from error
    rate = fps or written.fps or MADE_FPS
    count = frames or written.frames
    if count is None:
        count = FRAMES if items[0].at is None else round(float(knots[-1]) * rate) + 1
    if count > MOST:
        raise DataError(f"{path}: {count} frames at {rate:g} a second; allowed: up to {MOST}")
    return Film(path.stem, tuple(interpolate(keys, knots, np.linspace(0, knots[-1], count))), rate)


def _keyframe(path: Path, index: int, item: Any) -> Keyframe:
    where = f"{path}: keyframes[{index}]"
    if not isinstance(item, Mapping):
        raise DataError(f"{where} is {item!r:.60}; allowed: an object with a time and a camera")
    return strict.build(Keyframe, item, where)


def _key(scene: Scene, where: str, item: Keyframe) -> Key:
    if item.view is not None:
        try:
            return Key(find_view(scene, item.view).camera, item.time)
        except UsageError as error:
            raise DataError(f"{where}: view: {error}") from error
    assert item.position is not None and item.look_at is not None
    train = [view.camera for view in scene.split("train")]
    up = common_up(train) if item.up is None else np.array(item.up)
    position, target = np.array(item.position), np.array(item.look_at)
    with np.errstate(invalid="ignore"):
        pose = look_at(position, target, up)
    if not np.isfinite(pose).all():
        raise DataError(f"{where}: up is {up.tolist()}, along the line of sight; allowed: another")
    return Key(_camera(train[0], pose, item.field_of_view), item.time)


def _camera(first: Camera, pose: Any, angle: float | None) -> Camera:
    width, height = first.width, first.height
    focal = first.fy if angle is None else height / 2 / np.tan(np.radians(angle) / 2)
    return Camera(pose, float(focal), float(focal), width / 2, height / 2, width, height)


def _knots(path: Path, items: list[Keyframe]) -> Any:
    """Return where in the film the keys lie: seconds, or whole numbers where none are given."""
    given = [item.at for item in items if item.at is not None]
    if not given:
        return np.arange(len(items), dtype=np.float64)
    if len(given) < len(items):
        missing = next(i for i, item in enumerate(items) if item.at is None)
        raise DataError(
            f"{path}: keyframes[{missing}]: key 'at' is missing; allowed: at in all or in none"
        )
    if given[0] != 0:
        raise DataError(f"{path}: keyframes[0]: at is {given[0]:g}; allowed: 0, where it begins")
    for i in range(1, len(given)):
        if given[i] <= given[i - 1]:
            raise DataError(
                f"{path}: keyframes[{i}]: at is {given[i]:g}; allowed: more than the one before, "
                f"{given[i - 1]:g}"
            )
    return np.array(given)
