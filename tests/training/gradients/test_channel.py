"""What goes through a channel: orders and phases arrive as they are sent, and so do answers."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from typing import Any

import pytest
import torch
from motion_checks import disturbed, model_of, splats_of, stand_still, started

from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.model.model import Model
from gsdmsr_cli.training.gradients.channel import ForkedChannel
from gsdmsr_cli.training.gradients.phase import Order, Phase, ViewGradients
from gsdmsr_cli.training.gradients.shared_buffers import SharedBuffers

pytestmark = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="processes are not forked there"
)

COUNT, CAPACITY = 9, 12


class Echo:
    """Answers with what it was asked, in numbers; gradients are the values of the tensors."""

    def gradients(self, model: Model, orders: Sequence[Order], phase: Phase) -> list[ViewGradients]:
        (order,) = orders
        count, mask = len(model.splats), phase.gradient_mask
        on_screen = torch.zeros(count, 2)
        on_screen[:, 0] = torch.ones(count) if mask is None else mask
        on_screen[0, 1] = model.moving
        told = [order.row, order.jitter, phase.progress, float(phase.moving), float(phase.frozen)]
        told += [-1.0 if time is None else time for time in order.other_times]
        gradients = [None if "quats" in name else t.detach() for name, t in model.trained().items()]
        tiles = None if order.tile_weights is None else 2 * order.tile_weights
        errors = torch.tensor(told) if tiles is None else tiles
        return [ViewGradients(torch.tensor(0.25), gradients, on_screen, (4, 5), errors)]


class Failing:
    def gradients(self, model: Model, orders: Sequence[Order], phase: Phase) -> list[ViewGradients]:
        raise GsdmsrError("no such view")


ECHO = Echo()


def moving_model() -> Model:
    return model_of(splats_of(COUNT), disturbed(started("multiscale", COUNT)))


class Connection:
    """A channel to a worker that echoes, and the memory that both share."""

    def __init__(self, model: Model, renderer: Any = ECHO) -> None:
        self.model, self.published = model, SharedBuffers(model.parameters(), CAPACITY)
        given = renderer, model, self.published, CAPACITY, 2
        self.channel = ForkedChannel(*given, (), lambda: None)

    def ask(self, orders: Sequence[Order], phase: Phase) -> list[ViewGradients]:
        self.published.publish(self.model)
        self.channel.send(self.model, orders, phase)
        return self.channel.receive(self.model)


@pytest.fixture
def connection() -> Iterator[Connection]:
    made = Connection(moving_model())
    yield made
    made.channel.close()


def assert_echoed(found: ViewGradients, model: Model) -> None:
    assert len(found.on_screen) == len(model.splats)
    assert found.on_screen[0, 1] == model.moving
    for (name, tensor), gradient in zip(model.trained().items(), found.gradients, strict=True):
        if "quats" in name:
            assert gradient is None
        else:
            assert gradient is not None and torch.equal(gradient, tensor.detach()), name


def test_an_order_and_its_phase_arrive_as_they_are_sent(connection: Connection) -> None:
    mask = torch.arange(COUNT) % 2 == 0
    orders = [Order(7, None, -1.5, (None, 0.25)), Order(3, torch.tensor([0.0, 3.0, 0.5]))]
    first, second = connection.ask(orders, Phase(0.75, True, mask, frozen=True))
    assert first.loss == 0.25 and first.size == (4, 5)
    assert first.tile_errors is not None and second.tile_errors is not None
    assert first.tile_errors.tolist() == [7.0, -1.5, 0.75, 1.0, 1.0, -1.0, 0.25]
    assert second.tile_errors.tolist() == [0.0, 6.0, 1.0]
    assert torch.equal(first.on_screen[:, 0], mask.float())
    assert_echoed(first, connection.model)
    (found,) = connection.ask([Order(1)], Phase(0.0, False))
    assert found.on_screen[:, 0].all() and found.tile_errors is not None
    assert found.tile_errors.tolist() == [1.0, 0.0, 0.0, 0.0, 0.0]


def test_a_worker_follows_every_resize(connection: Connection) -> None:
    model, phase = connection.model, Phase(0.5, True)
    assert_echoed(connection.ask([Order(0)], phase)[0], model)
    rows = torch.tensor([8, 0, 0, 3, 1, 2, 4, 4, 5, 6, 7, 8])
    model.take(rows, torch.zeros(len(rows), dtype=torch.bool))
    assert_echoed(connection.ask([Order(0)], phase)[0], model)
    stand_still(model, torch.arange(12) < 5, model.splats.detach())
    assert_echoed(connection.ask([Order(0)], phase)[0], model)
    stand_still(model, torch.arange(12) < 12, model.splats.detach())
    assert model.moving == 0
    assert_echoed(connection.ask([Order(0)], phase)[0], model)


def test_splats_may_move_again_after_none_has() -> None:
    """As where a training with workers goes back to an earlier checkpoint."""
    model = moving_model()
    stand_still(model, torch.ones(COUNT, dtype=torch.bool), model.splats.detach())
    connection = Connection(model)
    try:
        assert_echoed(connection.ask([Order(0)], Phase(0.5, True))[0], model)
        connection.model = moving_model()
        assert_echoed(connection.ask([Order(0)], Phase(0.5, True))[0], connection.model)
    finally:
        connection.channel.close()


def test_what_goes_wrong_in_a_worker_is_raised_here_and_the_worker_ends() -> None:
    connection = Connection(moving_model(), Failing())
    try:
        with pytest.raises(GsdmsrError, match="no such view"):
            connection.ask([Order(0)], Phase(0.5, True))
        with pytest.raises(GsdmsrError, match=r"has ended \(exit code 0\)"):
            connection.ask([Order(0)], Phase(0.5, True))
    finally:
        connection.channel.close()
