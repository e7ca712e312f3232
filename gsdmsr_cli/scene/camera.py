"""A pinhole camera in OpenCV axes: x right, y down, z forward, pixel centres at +0.5."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Camera:
    """Where a picture was taken from and how it was projected.

    Attributes:
        world_to_camera: (4, 4) float64 rigid transform from world to camera axes, in world units.
        fx, fy: focal lengths [px].
        cx, cy: principal point [px]; the centre of a W x H image is (W / 2, H / 2).
        width, height: image size [px].
    """

    world_to_camera: NDArray[np.float64]
    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    def __post_init__(self) -> None:
        if self.world_to_camera.shape != (4, 4):
            raise ValueError(f"world_to_camera has shape {self.world_to_camera.shape}, not (4, 4)")
        if self.width < 1 or self.height < 1:
            raise ValueError(f"image size {self.width} x {self.height} is empty")

    @property
    def rotation(self) -> NDArray[np.float64]:
        """(3, 3) rotation from world to camera axes."""
        return self.world_to_camera[:3, :3]

    @property
    def translation(self) -> NDArray[np.float64]:
        """(3,) translation from world to camera axes."""
        return self.world_to_camera[:3, 3]

    @property
    def centre(self) -> NDArray[np.float64]:
        """(3,) position of the camera in the world."""
        return -self.rotation.T @ self.translation

    def resized(self, width: int, height: int) -> Camera:
        """Return the camera of the same picture resampled to ``width`` x ``height`` pixels."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            fx=self.fx * sx,
            fy=self.fy * sy,
            cx=self.cx * sx,
            cy=self.cy * sy,
            width=width,
            height=height,
        )

    def framed(self, width: int, height: int) -> Camera:
        """Return the camera with pictures of ``width`` x ``height`` pixels that crop nothing.

        The same picture resampled where the proportions are the same but for rounding; else one
        that shows more at two sides, round the same middle.
        """
        scale = min(width / self.width, height / self.height)
        if abs(self.width * scale - width) < 1 and abs(self.height * scale - height) < 1:
            return self.resized(width, height)
        return replace(
            self,
            fx=self.fx * scale,
            fy=self.fy * scale,
            cx=width / 2 + (self.cx - self.width / 2) * scale,
            cy=height / 2 + (self.cy - self.height / 2) * scale,
            width=width,
            height=height,
        )


def look_at(
    centre: NDArray[np.float64], target: NDArray[np.float64], up: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the (4, 4) world-to-camera transform of a camera at ``centre`` that faces ``target``.

    All arguments are (3,) world vectors; ``up`` points towards the top of the picture and must not
    be parallel to the line of sight.
    """
    forward = target - centre
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, up)
    right = right / np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    transform = np.eye(4)
    transform[:3, :3] = rotation
    transform[:3, 3] = -rotation @ centre
    return transform
