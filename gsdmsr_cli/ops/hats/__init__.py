"""Shares of evenly spaced nodes in what lies on straight lines between them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.backends.tensors import array
from gsdmsr_cli.ops.choose import choose
from gsdmsr_cli.ops.hats import cpu as kernels
from gsdmsr_cli.ops.hats import cuda
from gsdmsr_cli.ops.hats.twin import hats_twin

__all__ = ["hats", "hats_twin"]


def hats(times: Sequence[float], values: Tensor) -> Tensor:
    """Return how much values (F,) of evenly spaced times from 0 to 1 count at V times, (V, F).

    So ``hats(times, values) @ values`` are the values at the times. Those outside of [0, 1] are
    taken as the nearest within. In a step that is recorded the times are those of its views, and so
    they are when it is replayed.
    """
    form = choose(values)
    if form == "cuda":
        return cuda.hats(times, values)
    if form == "cpu":
        found = torch.empty(len(times), len(values))
        kernels.hats(np.array(times, np.float32), array(found))
        return found
    return hats_twin(times, values)
