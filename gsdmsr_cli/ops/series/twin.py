"""Adding series in plain torch."""

from __future__ import annotations

from torch import Tensor


def add_series_twin(
    start: Tensor, coefficients: Tensor, basis: Tensor, scale: float = 1.0, first: int = 0
) -> Tensor:
    """Return what ``add_series`` does, for any device and dtype; basis (N, K) or (1, K)."""
    terms, channels = basis.shape[1], coefficients.shape[2]
    used = coefficients[:, first : first + terms]
    added = start[:, :channels] + scale * (basis[:, :, None] * used).sum(dim=1)
    if channels == start.shape[1]:
        return added
    return start.slice_scatter(added, dim=1, end=channels)
