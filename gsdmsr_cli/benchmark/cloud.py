"""A cloud of splats like a trained scene's, for timing without data."""

from __future__ import annotations

import math

import numpy as np
import torch

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.scene.camera import Camera, look_at

SHELLS = 6
FIELD_OF_VIEW = 0.6911
"""Horizontal angle of D-NeRF's cameras [rad]."""


def cloud(count: int, seed: int = 0) -> Splats:
    """Return degree-0 splats in the unit ball: 70 % on six ellipsoids' surfaces, 30 % anywhere.

    Half are nearly opaque. Sizes shrink with the cube root of the count, so that the picture's
    coverage stays alike.
    """
    rng = np.random.default_rng(seed)

    def on_sphere(n: int) -> np.ndarray:
        directions: np.ndarray = rng.normal(size=(n, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        return directions

    shell = rng.integers(0, SHELLS, count)
    centres = rng.normal(size=(SHELLS, 3)) * 0.25
    radii = rng.uniform(0.25, 0.6, (SHELLS, 3))
    means = centres[shell] + on_sphere(count) * radii[shell] + rng.normal(size=(count, 3)) * 0.01
    inside = rng.random(count) < 0.3
    volume = on_sphere(count) * 0.9 * rng.random((count, 1)) ** (1 / 3)
    means = np.where(inside[:, None], volume, means)
    means /= np.maximum(np.linalg.norm(means, axis=1, keepdims=True), 1)
    typical = math.log(0.02 * (30_000 / count) ** (1 / 3))
    log_scales = typical + 0.35 * rng.normal(size=(count, 3)) + 0.45 * rng.normal(size=(count, 1))
    opaque = rng.random(count) < 0.5
    opacities = np.where(opaque, rng.uniform(0.8, 0.995, count), rng.uniform(0.02, 0.8, count))
    arrays = {
        "means": means,
        "quats": rng.normal(size=(count, 4)),
        "log_scales": log_scales,
        "logit_opacities": np.log(opacities / (1 - opacities)),
        "sh": (rng.random((count, 1, 3)) - 0.5) / SH_C0,
    }
    return Splats(**{name: torch.from_numpy(a.astype(np.float32)) for name, a in arrays.items()})


def camera(size: int) -> Camera:
    """Return a square camera four units from the origin, as D-NeRF's are."""
    azimuth, elevation, distance = 0.6, 0.3, 4.0
    centre = distance * np.array(
        [
            math.cos(elevation) * math.cos(azimuth),
            math.cos(elevation) * math.sin(azimuth),
            math.sin(elevation),
        ]
    )
    focal = 0.5 * size / math.tan(0.5 * FIELD_OF_VIEW)
    pose = look_at(centre, np.zeros(3), np.array([0.0, 0.0, 1.0]))
    return Camera(pose, focal, focal, size / 2, size / 2, size, size)
