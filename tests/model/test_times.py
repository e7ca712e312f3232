"""Times that splats begin with."""

from __future__ import annotations

import torch

from gsdmsr_cli.model.times import spread_times, take_known


def test_times_are_spread_evenly_also_over_few_neighbouring_rows() -> None:
    times = spread_times(1000)
    assert times.dtype == torch.float32 and times.min() >= 0 and times.max() < 1
    for rows in (times, times[300:320]):
        gaps = rows.sort().values.diff()
        assert gaps.max() < 3 / len(rows) and gaps.min() > 0.3 / len(rows)
    assert torch.equal(spread_times(5), times[:5])


def test_times_that_are_known_replace_others() -> None:
    centres = torch.tensor([0.1, 0.2, 0.3]).requires_grad_()
    take_known(centres, torch.tensor([torch.nan, 0.7, 0.0]))
    assert torch.equal(centres.detach(), torch.tensor([0.1, 0.7, 0.0]))
