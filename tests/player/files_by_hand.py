"""Writes small files of moving splats from docs/file-format.md alone, and says what they show.

Shares no code with the package's own writer and reader, so that each checks the other.
"""

from __future__ import annotations

import json
import struct
import zlib
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from gsdmsr_cli.gaussians.splats import Splats

Array = NDArray[np.float64]

SCENE = {
    "bound": 1.3, "up": [0, 0, 1], "background": [0.1, 0.2, 0.3], "seconds": 2.0,
    "view": {"position": [0, -4, 1], "target": [0, 0, 0], "up": [0, 0, 1], "fov_y": 0.7},
}  # fmt: skip
CODINGS = {"lives": "signed", "log_scales": "difference", "shares/splat/offset": "signed"}
"""How parts are coded, where not plainly; `curves/...` as differences."""

WIDTHS = {"quats": 2, "points": 2, "lives": 2, "log_radii": 1, "sh_rest": 1, "body": 1}


@dataclass
class File:
    """A scene to write.

    Attributes:
        tables: the values of all parts by name, row by row; `means` as places (N, 3).
        moving: how many splats move.
        degree: of the harmonics.
        times: how many values curves have.
        bodies: as in the header.
        warp: of the means.
        header: further fields of the header.
    """

    tables: dict[str, Array]
    moving: int = 0
    degree: int = 0
    times: int = 1
    bodies: dict[str, int] | None = None
    warp: float | None = None
    header: dict[str, Any] = field(default_factory=dict)

    def encode(self) -> bytes:
        """Return the bytes, and leave in ``tables`` the values that they hold, in their order."""
        entries, streams = [], []
        for name, (entry, stream) in self._parts().items():
            entries.append({"name": name, **entry, "bytes": len(stream)})
            streams.append(stream)
        document = {
            "splats": len(self.tables["means"]), "moving": self.moving, "sh_degree": self.degree,
            "times": self.times, "bodies": self.bodies, "parts": entries, "scene": SCENE,
            "about": {"written by": "hand"}, "unknown": [1],
        }  # fmt: skip
        text = json.dumps(document | self.header).encode()
        return b"dsplat\r\n" + struct.pack("<II", 1, len(text)) + text + b"".join(streams)

    def _parts(self) -> dict[str, tuple[dict[str, Any], bytes]]:
        parts = {"means": self._means()}
        parts["of a later version"] = (
            {"rows": 1, "columns": 1, "width": 1, "least": [0], "step": [1], "unknown": 2},
            zlib.compress(b"a"),
        )
        for name in [name for name in self.tables if name != "means"]:
            coding = "difference" if name.startswith("curves/") else CODINGS.get(name, "plain")
            width = WIDTHS.get(name, 2 if "/" in name else 1)
            parts[name], self.tables[name] = _table(self.tables[name], width, coding)
        return parts

    def _means(self) -> tuple[dict[str, Any], bytes]:
        """Code the means, and bring all rows of splats into the order of their codes."""
        p = self.tables["means"]
        if self.warp is not None:
            p = np.arcsinh(p / self.warp)
        least, step, q = _quantised(p, 16)
        codes = sum(
            ((q[:, axis] >> bit) & 1) << (3 * bit + axis) for axis in range(3) for bit in range(16)
        )
        moves = np.arange(len(p)) < self.moving
        order = np.lexsort([codes, ~moves])
        self._reorder(order)
        values = least + step * q[order]
        self.tables["means"] = values if self.warp is None else self.warp * np.sinh(values)
        codes = codes[order]
        halves = np.split(codes, [self.moving])
        u = np.concatenate([np.diff(half, prepend=0) for half in halves])
        entry = {"rows": len(p), "columns": 1, "width": 6, "step": list(step), "least": list(least)}
        if self.warp is not None:
            entry["warp"] = self.warp
        return entry, _packed(u[:, None], 6)

    def _reorder(self, order: NDArray[np.int64]) -> None:
        moving, own = order[: self.moving], ("lives", "body")
        for name, table in self.tables.items():
            if name in own or name.startswith("shares/splat/"):
                self.tables[name] = table[moving]
            elif "/" not in name and name not in ("points", "log_radii"):
                self.tables[name] = table[order]

    def at(self, t: float) -> Splats:
        """Return the splats at a time, in float64, as the page says step by step."""
        tables = self.tables
        m = self.moving
        quats = _whole_quats(tables["quats"])
        means, scales, opacities = (
            tables[name].copy() for name in ("means", "log_scales", "opacities")
        )
        colours = np.concatenate([tables["sh_0"], tables.get("sh_rest", tables["sh_0"][:, :0])], 1)
        if m and self.bodies:
            self._follow(t, means, quats, scales)
        if m:
            means[:m] += self._channels("splat/offset", 3, t, m)
            quats[:m] += self._channels("splat/turn", 4, t, m)
            scales[:m] += self._channels("splat/growth", 3, t, m)
            opacities[:m] += self._channels("splat/opacity", 1, t, m)
            opacities = opacities.clip(0, 1)
            colours[:m] += self._channels("splat/sh", colours.shape[1], t, m)
        if "lives" in tables:
            first, last, appearing, vanishing = tables["lives"].T
            early = np.maximum(0, first - t) / np.exp(appearing)
            late = np.maximum(0, t - last) / np.exp(vanishing)
            opacities[:m, 0] *= np.exp(-(early**2) - late**2)
        sh = _rgb(colours.reshape(len(means), (self.degree + 1) ** 2, 3))
        logits = torch.tensor(opacities[:, 0].clip(1e-9, 1 - 1e-12)).logit()
        return Splats(torch.tensor(means), torch.tensor(quats), torch.tensor(scales), logits,
                      torch.tensor(sh))  # fmt: skip

    def _follow(self, t: float, means: Array, quats: Array, scales: Array) -> None:
        assert self.bodies is not None
        count, neighbours, m = self.bodies["count"], self.bodies["neighbours"], self.moving
        points = self.tables["points"]
        offset, turn, growth = (
            self._channels(f"body/{name}", channels, t, count)
            for name, channels in (("offset", 3), ("turn", 4), ("growth", 3))
        )
        r = np.array([1.0, 0, 0, 0]) + turn
        r /= np.linalg.norm(r, axis=1, keepdims=True)
        new = [means[:m].copy(), quats[:m].copy(), scales[:m].copy()]
        for i in range(m):
            squares = ((means[i] - points) ** 2).sum(axis=1)
            if neighbours:
                near = np.argsort(squares, kind="stable")[:neighbours]
                radii = np.exp(self.tables["log_radii"][near, 0])
                weights = np.exp(-squares[near] / (2 * radii**2))
                weights /= weights.sum()
            else:
                near, weights = [int(self.tables["body"][i, 0])], [1.0]
            for body, weight in zip(near, weights, strict=True):
                moved = (_matrix(r[body]) - np.eye(3)) @ (means[i] - points[body]) + offset[body]
                new[0][i] += weight * moved
                new[1][i] += weight * _product(r[body] - np.array([1.0, 0, 0, 0]), quats[i])
                new[2][i] += weight * growth[body]
        means[:m], quats[:m], scales[:m] = new

    def _channels(self, name: str, channels: int, t: float, rows: int) -> Array:
        if f"curves/{name}" not in self.tables:
            return np.zeros((rows, channels))
        b = hermite(self.tables[f"curves/{name}"], t)
        return self.tables[f"shares/{name}"].reshape(rows, channels, len(b)) @ b


def hermite(table: Array, t: float) -> Array:
    """Return the values of curves (T, R) at a time."""
    u = t * (len(table) - 1)
    i = min(int(u), len(table) - 2)
    f = u - i
    slopes = np.gradient(table, axis=0)  # central differences, one-sided at the ends
    parts = (2 * f**3 - 3 * f**2 + 1, f**3 - 2 * f**2 + f, 3 * f**2 - 2 * f**3, f**3 - f**2)
    values = (table[i], slopes[i], table[i + 1], slopes[i + 1])
    return np.asarray(sum(a * b for a, b in zip(parts, values, strict=True)))


def _quantised(values: Array, bits: int) -> tuple[Array, Array, NDArray[np.int64]]:
    if not len(values):
        return np.zeros(values.shape[1]), np.ones(values.shape[1]), values.astype(np.int64)
    least = values.min(axis=0)
    step = np.maximum((values.max(axis=0) - least) / (2**bits - 1), 1e-9)
    return least, step, ((values - least) / step).round().astype(np.int64)


def _table(values: Array, width: int, coding: str) -> tuple[tuple[dict[str, Any], bytes], Array]:
    """Return a part, its entry first, and the values that it holds."""
    if values.dtype.kind == "i":
        least, step, q = np.zeros(1), np.ones(1), values.astype(np.int64)
    else:
        least, step, q = _quantised(values, 8 * width - (2 if coding != "plain" else 0))
    found = least + step * q
    entry: dict[str, Any] = {"rows": len(values), "columns": values.shape[1], "width": width}
    u = q
    if coding == "signed":  # values about the middle
        middle = 1 << (8 * width - 3)
        least, u = least + step * middle, _signs_last(q - middle)
        entry["signed"] = True
    elif coding == "difference":
        u = _signs_last(np.diff(q, axis=0, prepend=0))
        entry["difference"] = True
    entry |= {"least": least.tolist(), "step": step.tolist()}
    return (entry, _packed(u, width)), found


def _signs_last(v: NDArray[np.int64]) -> NDArray[np.int64]:
    return np.where(v >= 0, 2 * v, -2 * v - 1)


def _packed(u: NDArray[np.int64], width: int) -> bytes:
    """Return the zlib stream of unsigned integers (rows, columns)."""
    assert (u >= 0).all() and (u < 1 << (8 * width)).all()
    planes = [(u[:, c] >> (8 * k)) & 255 for c in range(u.shape[1]) for k in range(width)]
    return zlib.compress(np.array(planes, dtype=np.uint8).tobytes())


def _whole_quats(table: Array) -> Array:
    """Return quaternions wxyz from their x, y, z."""
    w = np.sqrt(np.maximum(0, 1 - (table**2).sum(axis=1, keepdims=True)))
    return np.concatenate([w, table], axis=1)


def _rgb(colours: Array) -> Array:
    """Return triples of Y, Co, Cg as red, green, blue."""
    y, co, cg = np.moveaxis(colours, -1, 0)
    return np.stack([y - cg + co, y + cg, y - cg - co], axis=-1)


def _matrix(q: Array) -> Array:
    w, x, y, z = q
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def _product(p: Array, q: Array) -> Array:
    (a, *u), (b, *v) = p, q
    return np.array([a * b - np.dot(u, v), *(a * np.array(v) + b * np.array(u) + np.cross(u, v))])


def still(count: int, degree: int = 0, seed: int = 0) -> File:
    """Return a scene of splats that stand still."""
    rng = np.random.default_rng(seed)
    quats = rng.normal(size=(count, 4))
    quats *= np.sign(quats[:, :1]) / np.linalg.norm(quats, axis=1, keepdims=True)
    tables = {
        "means": rng.normal(size=(count, 3)) * 0.5,
        "quats": quats[:, 1:] * 0.999,  # rounded up they would be longer than 1
        "log_scales": np.log(0.1) + 0.5 * rng.normal(size=(count, 3)),
        "opacities": rng.uniform(0, 1, size=(count, 1)),
        "sh_0": rng.normal(size=(count, 3)) * [1.2, 0.6, 0.6],
    }
    if degree:
        tables["sh_rest"] = rng.normal(size=(count, 3 * ((degree + 1) ** 2 - 1))) * 0.25
    return File(tables, degree=degree)


def with_curves(file: File, name: str, channels: int, size: float, curves: int = 3) -> None:
    """Give splats or bodies curves of a size."""
    rng = np.random.default_rng(sum(map(ord, name)))
    rows = file.bodies["count"] if name.startswith("body/") and file.bodies else file.moving
    table = rng.normal(size=(file.times, curves)).cumsum(axis=0)
    file.tables[f"curves/{name}"] = table - table[:1]
    file.tables[f"shares/{name}"] = size * rng.normal(size=(rows, curves * channels))


def with_bodies(count: int, neighbours: int, degree: int = 1) -> File:
    """Return a scene in which three of four splats follow bodies that move, turn and grow."""
    file, rng = still(160, degree, seed=3), np.random.default_rng(4)
    file.moving, file.times = 120, 7
    file.bodies = {"count": count, "neighbours": neighbours}
    file.tables["points"] = rng.normal(size=(count, 3)) * 0.5
    if neighbours:
        file.tables["log_radii"] = np.log(0.3) + 0.2 * rng.normal(size=(count, 1))
    else:
        file.tables["body"] = rng.integers(count, size=(file.moving, 1))
    with_curves(file, "body/offset", 3, 0.08)
    with_curves(file, "body/turn", 4, 0.12, curves=4)
    with_curves(file, "body/growth", 3, 0.05, curves=2)
    return file


def with_own_curves() -> File:
    """Return a scene in which splats have curves of their own, of every kind."""
    file = still(160, 1, seed=5)
    file.moving, file.times = 120, 6
    for name, channels, size, curves in (
        ("offset", 3, 0.1, 3), ("turn", 4, 0.15, 2), ("growth", 3, 0.1, 1), ("opacity", 1, 0.2, 5),
        ("sh", 12, 0.1, 2),
    ):  # fmt: skip
        with_curves(file, f"splat/{name}", channels, size, curves)
    return file


def with_few_curves(kind: str, splats: int, curves: int) -> File:
    """Return a scene in which each splat has a share of one of many curves of its own."""
    file, rng = still(splats, 1, seed=7), np.random.default_rng(11)
    file.moving, file.times = splats, 4
    name, channels = f"splat/{kind}", {"offset": 3, "sh": 12}[kind]
    with_curves(file, name, channels, 0.1, curves)
    whole = rng.integers(0, 3, size=(splats, channels, 1))  # which is coded without rounding
    there = np.arange(curves) == rng.integers(curves, size=(splats, 1, 1))
    file.tables[f"shares/{name}"] = (whole * there).reshape(splats, -1)
    file.tables[f"curves/{name}"] *= 0.1
    return file


def with_lives() -> File:
    """Return a scene in which splats appear and vanish, and some drift as well."""
    file, rng = with_own_curves(), np.random.default_rng(6)
    middle, half = rng.uniform(size=120), rng.uniform(0, 0.3, size=120)
    durations = rng.uniform(np.log(0.02), np.log(0.5), size=(120, 2))
    file.tables["lives"] = np.column_stack([middle - half, middle + half, durations])
    return file


def with_everything() -> File:
    """Return a scene that has every kind of part but ``body``, far places too."""
    file, rng = with_bodies(20, 4, degree=2), np.random.default_rng(8)
    for name, channels in (("offset", 3), ("turn", 4), ("growth", 3), ("opacity", 1), ("sh", 27)):
        with_curves(file, f"splat/{name}", channels, 0.05, 2)
    file.tables["lives"] = np.column_stack([
        rng.uniform(0, 0.5, 120), rng.uniform(0.5, 1, 120), np.log(rng.uniform(0.1, 0.4, (120, 2))),
    ])  # fmt: skip
    file.warp = 0.4
    file.tables["means"][120:] *= 3
    return file


def many(count: int) -> File:
    """Return a scene of many small splats, all of which follow 4 of 512 bodies."""
    file, rng = still(count, 1, seed=9), np.random.default_rng(10)
    file.tables["log_scales"] += np.log(0.1) - np.log(count / 10_000) / 2  # cover as much together
    file.moving, file.times, file.bodies = count, 12, {"count": 512, "neighbours": 4}
    file.tables["points"] = rng.normal(size=(512, 3)) * 0.5
    file.tables["log_radii"] = np.full((512, 1), np.log(0.15))
    with_curves(file, "body/offset", 3, 0.02, 8)
    with_curves(file, "body/turn", 4, 0.02, 8)
    return file
