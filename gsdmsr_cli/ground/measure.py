"""What the photometric loss is made of."""

from __future__ import annotations

from typing import NamedTuple

ALIKE = 0.025
"""Difference of colours that counts by its square as much as by itself."""


class Measure(NamedTuple):
    """How a drawn picture is compared with the true one.

    The loss is (1 - w) D + w (1 - SSIM), where D is the mean over pixels and channels of the
    differences d of colours: of |d|, or, where small ones are to count by their squares, of Huber's
    loss (1964), d^2 / 2 up to |d| = q and q (|d| - q / 2) from there on, divided by ``ALIKE``.

    Attributes:
        ssim: w, 0 to 1; 0.2 in 3DGS.
        quadratic: q, 0 or more; 0 for |d|.
    """

    ssim: float
    quadratic: float = 0.0
