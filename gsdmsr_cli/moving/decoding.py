"""What has been coded, read from the parts of a file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.moving.baked import COLOURS, OF_BODIES, OF_SPLATS, Baked, Bodies
from gsdmsr_cli.moving.coding import CURVES, SHARES, TO_YCOCG, in_other_colours
from gsdmsr_cli.moving.curves import Track
from gsdmsr_cli.moving.parts import Floats, Part, Table, values_of
from gsdmsr_cli.moving.places import NAME as MEANS
from gsdmsr_cli.moving.places import places_of
from gsdmsr_cli.moving.playing import UNSEEN

_TO_RGB = np.linalg.inv(TO_YCOCG)


def decoded(header: Mapping[str, Any], parts: Mapping[str, Part | Table]) -> Baked:
    """Return what parts say.

    Raises:
        KeyError, TypeError, ValueError, OverflowError: they do not fit together.
    """
    count, moving = int(header["splats"]), int(header["moving"])
    degree, times = int(header["sh_degree"]), int(header["times"])
    if not 0 <= moving <= count or not 0 <= degree <= 3 or times < 1:
        raise ValueError(f"{moving} of {count} splats that move, of degree {degree}")
    read = _Reader(parts)
    colours = read.table("sh_0", count, 3)
    if degree:
        rest = read.table("sh_rest", count, 3 * ((degree + 1) ** 2 - 1))
        colours = np.concatenate([colours, rest], axis=1)
    sh = colours.reshape(count, (degree + 1) ** 2, 3) @ _TO_RGB.T
    turned = read.table("quats", count, 3)
    w = np.sqrt(np.clip(1 - np.square(turned).sum(axis=1, keepdims=True), 0, None))
    opacities = read.table("opacities", count, 1)[:, 0].clip(UNSEEN, 1 - UNSEEN)
    splats = Splats(
        _tensor(places_of(read.part(MEANS, count, 1), moving)),
        _tensor(np.concatenate([w, turned], axis=1)),
        _tensor(read.table("log_scales", count, 3)),
        _tensor(np.log(opacities) - np.log1p(-opacities)),
        _tensor(sh),
    )
    lives = _tensor(read.table("lives", moving, 4)) if "lives" in parts else None
    bodies = _bodies_of(header.get("bodies"), read, moving)
    tracks = {}
    for name, channels in {**OF_BODIES, **OF_SPLATS, COLOURS: 3 * (degree + 1) ** 2}.items():
        if CURVES + name in parts:
            rows = moving if name not in OF_BODIES else 0 if bodies is None else len(bodies.points)
            tracks[name] = _track_of(name, read, rows, channels, times)
    return Baked(splats, moving, times, bodies, tracks, lives)


def _bodies_of(about: Any, read: _Reader, moving: int) -> Bodies | None:
    if about is None:
        return None
    count, neighbours = int(about["count"]), int(about["neighbours"])
    points = _tensor(read.table("points", count, 3))
    if neighbours:
        if not 1 <= neighbours <= count:
            raise ValueError(f"{count} bodies for {neighbours} neighbours")
        return Bodies(points, _tensor(read.table("log_radii", count, 1)[:, 0]), None, neighbours)
    body = read.table("body", moving, 1)[:, 0]
    if len(body) and not (body.min() >= 0 and body.max() < count):
        raise ValueError(f"splats that follow other bodies than the {count} that there are")
    return Bodies(points, None, torch.from_numpy(np.rint(body).astype(np.int64)), 0)


def _track_of(name: str, read: _Reader, rows: int, channels: int, times: int) -> Track:
    rank = read.parts[CURVES + name].columns
    curves = read.table(CURVES + name, times, rank)
    shares = read.table(SHARES + name, rows, rank * channels).reshape(rows, channels, rank)
    if name == COLOURS:
        shares = in_other_colours(shares, _TO_RGB)
    return Track(_tensor(curves), _tensor(shares))


class _Reader:
    """Parts by name, whose sizes are checked."""

    def __init__(self, parts: Mapping[str, Part | Table]) -> None:
        self.parts = parts

    def part(self, name: str, rows: int, columns: int) -> Part | Table:
        part = self.parts[name]
        if (part.rows, part.columns) != (rows, columns):
            found = f"{part.rows} x {part.columns}"
            raise ValueError(f"part '{name}' is {found}, not {rows} x {columns}")
        return part

    def table(self, name: str, rows: int, columns: int) -> Floats:
        values = values_of(self.part(name, rows, columns))
        if not np.isfinite(values).all():
            raise ValueError(f"part '{name}' holds values that are not finite")
        return values


def _tensor(values: Floats) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
