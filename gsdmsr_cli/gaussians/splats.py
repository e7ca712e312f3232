"""Gaussian splats as tensors, named by the space in which they are stored."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Splats:
    """N anisotropic 3D Gaussians with opacity and spherical-harmonic colour.

    Attributes:
        means: (N, 3) centres [world units].
        quats: (N, 4) rotations, wxyz, not necessarily normalised.
        log_scales: (N, 3) natural logarithm of the standard deviations [world units].
        logit_opacities: (N,) logit of the opacity.
        sh: (N, K, 3) spherical-harmonic coefficients, K = (degree + 1)^2, degree 0 to 3.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    logit_opacities: Tensor
    sh: Tensor

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        expected = {
            "means": (n, 3),
            "quats": (n, 4),
            "log_scales": (n, 3),
            "logit_opacities": (n,),
        }
        for name, shape in expected.items():
            found = tuple(getattr(self, name).shape)
            if found != shape:
                raise ValueError(f"{name} has shape {found}, not {shape}")
        if self.sh.shape not in [(n, k, 3) for k in (1, 4, 9, 16)]:
            raise ValueError(f"sh has shape {tuple(self.sh.shape)}, not ({n}, 1|4|9|16, 3)")

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        """Degree of the stored spherical harmonics."""
        return int(self.sh.shape[1] ** 0.5) - 1

    def degree_up_to(self, limit: int | None) -> int:
        """Return the degree that is drawn: what is stored, or ``limit`` if that is less."""
        return self.sh_degree if limit is None else min(limit, self.sh_degree)

    def tensors(self) -> dict[str, Tensor]:
        """Return the five tensors by name, in the order of the attributes."""
        return {name: getattr(self, name) for name in NAMES}

    def map(self, function: Callable[[Tensor], Tensor]) -> Splats:
        """Return the splats with ``function`` applied to every tensor."""
        return Splats(**{name: function(tensor) for name, tensor in self.tensors().items()})

    def take(self, rows: Tensor) -> Splats:
        """Return the splats whose row i is the parent's row ``rows[i]``; rows is (M,) int64."""
        return self.map(lambda tensor: tensor[rows])

    def detach(self) -> Splats:
        """Return the same values outside the autograd graph."""
        return self.map(torch.Tensor.detach)


def together(parts: Sequence[Splats]) -> Splats:
    """Return the rows of several splats, one after the other."""
    columns = [part.tensors() for part in parts]
    return Splats(**{name: torch.cat([column[name] for column in columns]) for name in NAMES})


NAMES = tuple(field.name for field in fields(Splats))
"""The five tensors' names, in the order of the attributes."""
