"""What a training asks of the processes that share its steps, and the answers of one alone."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import torch

from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.training.gradients.phase import Order, ViewGradients
from gsdmsr_cli.training.schedule import Clock


class RanksDifferError(GsdmsrError):
    """Ranks that should hold the same model do not."""


class Ranks(Protocol):
    """The processes that make the steps of one training together, seen from one of them.

    Attributes:
        rank: of this process, from 0; the first one keeps the run folder.
        size: how many there are.
    """

    rank: int
    size: int

    def share(self, orders: Sequence[Order]) -> Sequence[Order]:
        """Return those of a step's orders that this process is to render."""

    def gather(
        self,
        model: Model,
        orders: Sequence[Order],
        own: Sequence[ViewGradients],
        with_screens: bool,
    ) -> Sequence[ViewGradients]:
        """Return what all views of a step have given, in their order.

        Args:
            model: that was rendered.
            orders: of the step.
            own: what this process's share of them has given.
            with_screens: whether anybody asks for the gradients on the screen; else they are empty.

        Returns:
            The gradients of all views are summed up in their order, and are those of the first.

        Raises:
            GsdmsrError: the connection to another process is lost.
        """

    def meet(
        self, clock: Clock, model: Model, generator: torch.Generator, end_wanted: bool
    ) -> bool:
        """Agree on the time, and return whether any process wants to end; before every step.

        Raises:
            RanksDifferError: they hold different models.
            GsdmsrError: the connection to another process is lost.
        """

    def account(self) -> dict[str, Any]:
        """Return what the exchange has cost, as plain JSON."""


class Alone:
    """One process, which renders all views by itself. See ``Ranks``."""

    rank, size = 0, 1

    def share(self, orders: Sequence[Order]) -> Sequence[Order]:
        """Return all of them."""
        return orders

    def gather(
        self,
        model: Model,
        orders: Sequence[Order],
        own: Sequence[ViewGradients],
        with_screens: bool,
    ) -> Sequence[ViewGradients]:
        """Return them as they are."""
        return own

    def meet(
        self, clock: Clock, model: Model, generator: torch.Generator, end_wanted: bool
    ) -> bool:
        """Return what this process wants."""
        return end_wanted

    def account(self) -> dict[str, Any]:
        """Return nothing."""
        return {}


ALONE = Alone()


def most_of(views: int, size: int) -> int:
    """Return how many views of a step the busiest of ``size`` processes renders."""
    return -(-views // size)
