"""Packs a model's tensors into few bytes and back (Compact 3DGS, Lee et al., arXiv 2408.03822).

Splats that are never drawn are left out, the others put in Morton order. Rotations and scales are
the codes of the layer ``quantise`` where there is one; positions and small tensors have 16 bits a
value, all else 8 bits between the least and the largest value of its column. All is deflated.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.model.layers.colour import Colour
from gsdmsr_cli.model.layers.mask import Mask
from gsdmsr_cli.model.layers.quantise import Quantise, decode
from gsdmsr_cli.model.model import FURTHER, MOVING, STORED_AS, Model
from gsdmsr_cli.model.parameter import Parameter

Array = NDArray[Any]
Description = dict[str, dict[str, Any]]
"""Of each tensor its "kind", its "shape" and the "type" of its values, plain JSON."""

SMALL = 16384
"""Values of a shared tensor up to which they have 16 bits each: most networks."""

_LEVELS = 255
_BOOKS = f"{FURTHER}quantise."


@torch.no_grad()
def pack(model: Model) -> tuple[dict[str, Tensor], Description]:
    """Return what the tensors of a model become, uint8 each, and what tells how to read them.

    The model is left with the splats that are packed, in their order.

    Raises:
        DataError: a value is not finite.
    """
    rows = _in_order(model)
    model.take(rows, torch.zeros_like(rows, dtype=torch.bool))
    codes = _settle(model)
    packed: dict[str, Tensor] = {}
    described: Description = {}
    for parameter in model.parameters():
        name, values = parameter.name, parameter.tensor.detach().cpu().numpy()
        kind = "codes" if name in codes else _kind(parameter)
        if not np.isfinite(values).all():
            raise DataError(f"'{name}' holds values that are not finite; train again")
        given = codes[name].cpu().numpy().astype(np.uint8) if name in codes else values
        described[name] = {"kind": kind, "shape": list(given.shape), "type": str(given.dtype)}
        packed[name] = _deflated(_ENCODED[kind](given))
    if model.moving < len(model.splats):
        described[MOVING] = {"kind": "raw", "shape": [], "type": "int64"}
        packed[MOVING] = _deflated(np.array(model.moving, np.int64).tobytes())
    return packed, described


def unpack(packed: Mapping[str, Tensor], described: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the tensors that have been packed.

    Raises:
        ValueError, LookupError, TypeError: they are not what the description says.
    """
    found = {name: _decoded(packed[name], about) for name, about in described.items()}
    for name, about in described.items():
        if about["kind"] == "codes":
            book = found[_BOOKS + name.removeprefix(STORED_AS)]
            if int(found[name].max(initial=0)) >= book.shape[1] or found[name].shape[1] > len(book):
                raise ValueError(f"'{name}' has codes that its codebook has not")
            found[name] = decode(
                torch.from_numpy(found[name]).long(), torch.from_numpy(book)
            ).numpy()
    return {name: torch.from_numpy(values) for name, values in found.items()}


def _in_order(model: Model) -> Tensor:
    """Return the rows (M,) that are drawn, those that move first, either in Morton order."""
    kept = torch.ones(len(model.splats), dtype=torch.bool)
    for layer in model.layers.values():
        own = layer.kept()
        if own is not None:
            kept[: len(own)] &= own.cpu()
    means = model.splats.means.detach().cpu()
    low, high = means.amin(dim=0), means.amax(dim=0)
    cells = ((means - low) / (high - low).clamp(min=1e-9) * 1023).long().clamp(0, 1023)
    order = torch.zeros(len(means), dtype=torch.int64)
    for bit in range(10):
        for axis in range(3):
            order |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    order += (torch.arange(len(means)) >= model.moving).long() << 30
    rows = order.argsort(stable=True)
    return rows[kept[rows]].to(model.splats.means.device)


def _settle(model: Model) -> dict[str, Tensor]:
    """Let layers need nothing that is not packed; return the codes of tensors that have them.

    What is drawn stays the same: masks hide none of the splats that are left, rounded values need
    not be rounded once more, and coefficients that a field takes the place of are not read.
    """
    codes: dict[str, Tensor] = {}
    for layer in model.layers.values():
        if isinstance(layer, Mask):
            layer.logits.fill_(1.0)
        elif isinstance(layer, Colour):
            model.splats.sh.zero_()
        elif isinstance(layer, Quantise) and layer.fitted.any():
            own = layer.encode(model.splats)
            codes = {STORED_AS + name: chosen for name, chosen in own.items()}
            layer.fitted.zero_()
    return codes


def _kind(parameter: Parameter) -> str:
    tensor = parameter.tensor
    if parameter.rate is None or not tensor.is_floating_point():
        return "raw"
    small = not parameter.per_splat and tensor.numel() <= SMALL
    return "half" if small or parameter.name == f"{STORED_AS}means" else "bytes"


def _halves(values: Array) -> bytes:
    """Return 16 bits a value, column by column, all lower bytes before all higher ones."""
    with np.errstate(over="ignore"):
        columns = _columns(values).T.astype("<f2")
    if not np.isfinite(columns).all():
        raise DataError("a value is too large for 16 bits")
    halves: bytes = np.frombuffer(columns.tobytes(), np.uint8).reshape(-1, 2).T.tobytes()
    return halves


def _levels(values: Array) -> bytes:
    """Return the least value and the step of each column, then 8 bits a value by column."""
    columns = _columns(values).astype("<f4")
    ends = np.zeros((2, columns.shape[1]), "<f4")
    if len(columns):
        ends[0], ends[1] = columns.min(axis=0), np.ptp(columns, axis=0) / _LEVELS
    places = np.round((columns - ends[0]) / np.where(ends[1] > 0, ends[1], 1)).clip(0, _LEVELS)
    levels: bytes = places.astype(np.uint8).T.tobytes()
    return ends.tobytes() + levels


_ENCODED: dict[str, Callable[[Array], bytes]] = {
    "half": _halves,
    "bytes": _levels,
    "codes": lambda values: values.T.tobytes(),
    "raw": lambda values: values.tobytes(),
}


def _columns(values: Array) -> Array:
    """Return an array as a table: its last axis are the columns, where it has two axes or more."""
    return values.reshape(-1, values.shape[-1] if values.ndim > 1 and values.shape[-1] else 1)


def _deflated(data: bytes) -> Tensor:
    return torch.frombuffer(bytearray(zlib.compress(data, 9)), dtype=torch.uint8)


def _inflated(data: Tensor, length: int) -> bytes:
    """Return the bytes that were deflated; raise ValueError unless they are so many."""
    inflater = zlib.decompressobj()
    try:
        found = inflater.decompress(data.numpy().tobytes(), length + 1)
    except zlib.error as error:
        raise ValueError(f"packed data is damaged: {error}") from error
    if len(found) != length or not inflater.eof:
        raise ValueError(f"packed data has not the {length} bytes that it should have")
    return found


def _decoded(data: Tensor, about: Mapping[str, Any]) -> Array:
    """Return the values of a packed tensor; of codes, the codes."""
    kind, shape, dtype = about["kind"], tuple(map(int, about["shape"])), np.dtype(about["type"])
    if kind not in _ENCODED or min(shape, default=0) < 0:
        raise ValueError(f"nothing is packed as '{kind}' of shape {shape}")
    count = math.prod(shape)
    if kind == "raw":
        return np.frombuffer(_inflated(data, count * dtype.itemsize), dtype).reshape(shape).copy()
    if kind == "codes":
        codes = np.frombuffer(_inflated(data, count), np.uint8)
        return codes.reshape(shape[::-1]).T.copy()
    width = shape[-1] if len(shape) > 1 and shape[-1] else 1
    if kind == "half":
        parts = np.frombuffer(_inflated(data, 2 * count), np.uint8).reshape(2, -1)
        columns = np.frombuffer(parts.T.tobytes(), "<f2").reshape(width, -1)
        return columns.T.reshape(shape).astype(np.float32)
    found = _inflated(data, 8 * width + count)
    low, step = np.frombuffer(found[: 8 * width], "<f4").reshape(2, width)
    places = np.frombuffer(found[8 * width :], np.uint8).reshape(width, -1).T
    return (low + step * places).astype(np.float32).reshape(shape)
