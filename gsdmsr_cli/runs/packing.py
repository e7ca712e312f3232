"""Packs a model's tensors into few bytes and back (Compact 3DGS, Lee et al., arXiv 2408.03822).

Splats that are never drawn are left out, the others put in Morton order. Rotations and scales are
the codes of the layer ``quantise`` where there is one. All else has as few bits a value as leave
what is drawn where it is, within a tolerance; all is compressed.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.model.layers.colour import Colour
from gsdmsr_cli.model.layers.mask import Mask
from gsdmsr_cli.model.layers.quantise import Quantise, decode
from gsdmsr_cli.model.model import FURTHER, MOVING, STORED_AS, Model
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.runs import packed_values
from gsdmsr_cli.runs.tolerance import forms_of

Description = dict[str, Any]
"""The "layout" and how each of the "tensors" is written, see ``packed_values.encode``; JSON."""

LAYOUT = 2
"""Of what is packed. In 1 values had 8 bits between the ends of their column, or 16, deflated."""

TOLERANCE = 0.08
"""How far what is drawn may be off by rounding, see ``tolerance.distance``."""

_BOOKS = f"{FURTHER}quantise."


@torch.no_grad()
def pack(model: Model, tolerance: float = TOLERANCE) -> tuple[dict[str, Tensor], Description]:
    """Return what the tensors of a model become, uint8 each, and what tells how to read them.

    The model is left with the splats that are packed, in their order.

    Args:
        model: what is packed.
        tolerance: see ``tolerance.forms_of``.

    Raises:
        DataError: a value is not finite.
    """
    _require_finite(model)
    rows = _in_order(model)
    model.take(rows, torch.zeros_like(rows, dtype=torch.bool))
    codes = _settle(model)
    as_they_are = {*codes, *_of_views(model)}
    trained = [p.name for p in model.parameters() if _is_trained(p) and p.name not in as_they_are]
    forms = forms_of(model, tolerance, trained)
    packed: dict[str, Tensor] = {}
    described: dict[str, dict[str, Any]] = {}
    for name, tensor in model.tensors().items():
        if name in codes:
            given, form = codes[name].cpu().numpy().astype(np.uint8), packed_values.CODES
        else:
            given, form = tensor.detach().cpu().numpy(), forms.get(name, packed_values.RAW)
        packed[name], described[name] = packed_values.encode(given, form)
    if model.moving < len(model.splats):
        moving = np.array(model.moving, np.int64)
        packed[MOVING], described[MOVING] = packed_values.encode(moving, packed_values.RAW)
    return packed, {"layout": LAYOUT, "tensors": described}


def unpack(
    packed: Mapping[str, Tensor], described: Mapping[str, Any], path: Path
) -> dict[str, Tensor]:
    """Return the tensors that have been packed, of a file that lies at ``path``.

    Raises:
        ValueError, LookupError, TypeError: they are not what the description says.
        DataError: they are packed as another version does it.
    """
    layout = described.get("layout", 1)
    if layout != LAYOUT:
        raise DataError(
            f"{path}: is packed in layout {layout}, and this version reads {LAYOUT}; export it "
            "again from the run that it was made of"
        )
    tensors = described["tensors"]
    found = {name: packed_values.decode(packed[name], about) for name, about in tensors.items()}
    for name, about in tensors.items():
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

    What is drawn stays the same: masks hide none of the splats that are left, sums of codes stand
    where they stood for values, and coefficients that a field takes the place of are not read.
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
            for name, chosen in own.items():
                getattr(model.splats, name).copy_(decode(chosen, layer.books[name]))
            layer.fitted.zero_()
            layer.check()  # which now says that there is nothing to do
    return codes


def _of_views(model: Model) -> list[str]:
    """Return the names of what layers hold of views: what is drawn at a time does not show it."""
    holding = {key: layer for key, layer in model.layers.items() if layer.holds_views}
    return [f"{key}.{one.name}" for key, layer in holding.items() for one in layer.parameters()]


def _is_trained(parameter: Parameter) -> bool:
    return parameter.rate is not None and parameter.tensor.is_floating_point()


def _require_finite(model: Model) -> None:
    for name, tensor in model.tensors().items():
        if not tensor.isfinite().all():
            raise DataError(f"'{name}' holds values that are not finite; train again")
