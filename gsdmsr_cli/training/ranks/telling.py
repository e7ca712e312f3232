"""What ranks tell each other of their views beside gradients, as one row of bytes per rank."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from gsdmsr_cli.training.gradients.phase import Order, ViewGradients


class Told(NamedTuple):
    """What a view has given, but for the gradients.

    Attributes:
        loss, size, on_screen, tile_errors: see ``ViewGradients``; (0, 2) where nobody asks for
            ``on_screen``.
        there: of each trained tensor, whether it has a gradient.
    """

    loss: Tensor
    size: tuple[int, int]
    on_screen: Tensor
    tile_errors: Tensor | None
    there: list[bool]


def pack(
    views: Sequence[ViewGradients], orders: Sequence[Order], with_screens: bool, length: int
) -> Tensor:
    """Return what the views have given as (length,) bytes, zeros behind it."""
    row = torch.zeros(length, dtype=torch.uint8)
    start = 0
    for view, order in zip(views, orders, strict=True):
        errors = view.tile_errors
        counts = tiles_of(order)
        head = [view.loss.item(), *view.size, errors is not None]
        there = [gradient is not None for gradient in view.gradients]
        pieces = [torch.tensor([*head, *there], dtype=torch.float64)]
        if counts:
            known = torch.zeros(counts) if errors is None else errors
            pieces.append(known.double())
        if with_screens:
            pieces.append(view.on_screen.detach().float().flatten())
        for piece in pieces:
            told = piece.contiguous().view(torch.uint8)
            row[start : start + len(told)] = told
            start += len(told)
    return row


def length_of(order: Order, tensors: int, splats: int) -> int:
    """Return the bytes of a view: numbers of 8 bytes, and ``splats`` rows of the screen."""
    return 8 * (4 + tensors + tiles_of(order) + splats)


def unpack(row: Tensor, orders: Sequence[Order], tensors: int, splats: int) -> list[Told]:
    """Return what ``pack`` was given for these orders.

    Args:
        row: of bytes.
        orders: of the rank that has sent it.
        tensors: how many are trained.
        splats: how many there are, 0 where nobody asks for the screen.
    """
    found, start = [], 0
    for order in orders:
        own = row[start : start + length_of(order, tensors, splats)]
        start += len(own)
        counts = tiles_of(order)
        numbers = own[: 8 * (4 + tensors + counts)].view(torch.float64)
        loss, width, height, has_errors, *there = numbers[: 4 + tensors].tolist()
        errors = numbers[4 + tensors :] if counts and has_errors else None
        on_screen = own[len(own) - 8 * splats :].view(torch.float32).view(-1, 2)
        size, known = (int(width), int(height)), [bool(flag) for flag in there]
        found.append(Told(torch.tensor(loss), size, on_screen, errors, known))
    return found


def tiles_of(order: Order) -> int:
    """Return of how many tiles a view's errors are wanted: where they have been chosen."""
    return 0 if order.tile_weights is None else len(order.tile_weights)
