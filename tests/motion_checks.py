"""Small motions and splats for tests, and how a motion is made to move."""

from __future__ import annotations

from typing import Any

import torch
from kernel_checks import generator
from torch import Tensor

from gsdmsr_cli.motion import Facts, Motion, start_motion
from gsdmsr_cli.splats import Splats

FACTS = Facts(bound=1.3, box=((-1.3, -1.2, -1.1), (1.3, 1.4, 1.0)), frames=20)


def splats_of(count: int, seed: int = 0) -> Splats:
    """Return splats whose means fill the box of ``FACTS``."""
    rng = generator(seed)
    return Splats(
        means=(torch.rand(count, 3, generator=rng) * 2 - 1) * FACTS.bound,
        quats=torch.randn(count, 4, generator=rng),
        log_scales=torch.randn(count, 3, generator=rng) - 3,
        logit_opacities=torch.randn(count, generator=rng),
        sh=torch.randn(count, 4, 3, generator=rng),
    )


def started(name: str, count: int = 1, **options: Any) -> Motion:
    """Return the motion as training starts it with so many splats."""
    return start_motion({"name": name, **options}, FACTS, count, generator())


def disturbed(motion: Motion) -> Motion:
    """Return the motion in its last phase, with every tensor moved away from its start."""
    motion.advance(1.0)
    rng = generator(1)
    with torch.no_grad():
        for tensor in motion.tensors().values():
            tensor += 0.1 * torch.randn(tensor.shape, generator=rng)
    return motion


def are_among(points: Tensor, others: Tensor) -> bool:
    """Tell whether every point (N, 3) is one of the others, to the last bit."""
    return set(map(tuple, points.tolist())) <= set(map(tuple, others.tolist()))
