"""What the photometric loss is made of."""

from __future__ import annotations

from typing import NamedTuple

ALIKE = 0.025
"""Difference of colours that counts by its square as much as by itself."""

_STEEPEST = 1e30
"""1 / q of a q that any difference is beyond."""


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

    def bend(self) -> tuple[float, float, float]:
        """Return 1 / q and q / 2, as kernels take them, and what their distances count.

        Which are Huber's loss divided by q; with a q that any difference is beyond they are |d|.
        """
        q = self.quadratic
        return (1 / q, q / 2, q / ALIKE) if q else (_STEEPEST, 0.0, 1.0)
