"""The window and the constants of SSIM, as 3DGS and the papers after it have them.

Wang et al. 2004: means under a Gaussian window of 11 x 11 px with sigma 1.5 px, which is the outer
product of ``WINDOW`` with itself; C1 and C2 keep the fractions finite, for values in [0, 1].
"""

from __future__ import annotations

import numpy as np

REACH = 5
"""Pixels on either side of the middle of the window."""

SIGMA = 1.5
"""Standard deviation of the window [px]."""

C1, C2 = 0.01**2, 0.03**2

_WEIGHTS = np.exp(-0.5 * np.arange(-REACH, REACH + 1) ** 2 / SIGMA**2)
WINDOW = _WEIGHTS / _WEIGHTS.sum()
"""(11,) float64, sums to 1."""
