"""How far what each pixel shows has gone in another picture, and where that can be believed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.scene.native import cv2

Grey = NDArray[np.uint8]
Floats32 = NDArray[np.float32]


def optical_flow(here: Grey, there: Grey) -> Floats32:
    """Return the (H, W, 2) displacements x, y from one (H, W) picture to another [px].

    By dense inverse search (Kroeger et al., ECCV 2016). What it finds depends on the number of
    OpenCV's threads.
    """
    pair = np.ascontiguousarray(here), np.ascontiguousarray(there)
    dis = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return np.asarray(dis.calc(*pair, None), dtype=np.float32)  # type: ignore[call-overload]


def ends_of(flow: Floats32) -> tuple[Floats32, Floats32]:
    """Return the columns and rows (H, W) at which the pixels of a flow (H, W, 2) arrive."""
    height, width = flow.shape[:2]
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height))
    return columns + flow[..., 0], rows.astype(np.float32) + flow[..., 1]


def trusted(forward: Floats32, back: Floats32, most: float) -> NDArray[np.bool_]:
    """Return the pixels (H, W) whose flow there and back ends less than ``most`` [px] from them.

    Those whose flow leaves the picture are none of them.
    """
    height, width = forward.shape[:2]
    to_x, to_y = ends_of(forward)
    returned = forward + cv2.remap(back, to_x, to_y, cv2.INTER_LINEAR)
    inside = (to_x >= 0) & (to_x <= width - 1) & (to_y >= 0) & (to_y <= height - 1)
    return np.asarray(inside & (np.linalg.norm(returned, axis=2) < most))
