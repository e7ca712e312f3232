"""What ranks tell of their views arrives as it was sent."""

from __future__ import annotations

import pytest
import torch

from gsdmsr_cli.training.gradients.phase import Order, ViewGradients
from gsdmsr_cli.training.ranks.telling import length_of, pack, unpack


def view(loss: float, splats: int, errors: torch.Tensor | None) -> ViewGradients:
    gradients = [torch.ones(3), None, torch.ones(2)]
    on_screen = torch.randn(splats, 2, generator=torch.Generator().manual_seed(int(100 * loss)))
    return ViewGradients(torch.tensor(loss), gradients, on_screen, (640, 361), errors)


@pytest.mark.parametrize("splats", [0, 1, 7])
def test_views_arrive_as_they_are_sent(splats: int) -> None:
    errors = torch.tensor([0.1, 0.2, torch.nan], dtype=torch.float64)
    orders = [Order(3), Order(4, torch.ones(3)), Order(5, torch.ones(2))]
    views = [view(0.1, splats, errors), view(1 / 3, splats, errors), view(0.7, splats, None)]
    lengths = [length_of(order, 3, splats) for order in orders]
    row = pack(views, orders, splats > 0, sum(lengths) + 16)
    assert row.dtype == torch.uint8 and not row[-16:].any()
    for found, sent, order in zip(unpack(row, orders, 3, splats), views, orders, strict=True):
        assert torch.equal(found.loss, sent.loss) and found.loss.dtype == torch.float32
        assert found.size == (640, 361) and found.there == [True, False, True]
        assert torch.equal(found.on_screen, sent.on_screen)
        if order.row == 4:
            assert found.tile_errors is not None
            assert torch.equal(found.tile_errors, errors) or found.tile_errors[2].isnan()
            assert found.tile_errors[:2].tolist() == [0.1, 0.2]
        else:
            assert found.tile_errors is None  # nobody has asked, or there were none


def test_nobody_pays_for_the_screen_where_nobody_asks() -> None:
    assert length_of(Order(0), 5, 0) == 8 * 9
    assert length_of(Order(0), 5, 1000) == 8 * 9 + 8 * 1000
    (found,) = unpack(pack([view(0.5, 4, None)], [Order(0)], False, 56), [Order(0)], 3, 0)
    assert found.on_screen.shape == (0, 2)
