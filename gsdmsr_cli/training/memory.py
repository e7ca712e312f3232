"""How much memory a training will take, told before it starts."""

from __future__ import annotations

from dataclasses import asdict, dataclass

from gsdmsr_cli.options.preset import Preset
from gsdmsr_cli.scene.block_store import BLOCK, blocks
from gsdmsr_cli.scene.scene import View

_VALUES, _HARMONICS = 11, 3
"""Numbers of a splat: mean, rotation, scales and opacity; and of each of its harmonics."""

_OWN, _IN_EACH = 450, 400
"""Bytes per splat besides its tensors: statistics, and what drawing and its gradients need, in the
process that trains; and in each further one. Measured on the CPU."""

_PER_PIXEL = 60
"""Bytes per pixel that drawing and its gradients need, in each process."""

_PROCESS = 45 << 20
"""Bytes of a process for nothing but being there."""


@dataclass(frozen=True)
class Estimate:
    """What a training will take besides the program itself [bytes].

    Attributes:
        pictures: decoded pictures, masks and halved pictures, at most ``data.cache_mib``.
        splats: as many as ``density.cap`` allows, with gradients, moments of Adam and statistics.
        processes: those that take gradients beside this one.
        drawing: pixels of the views that are drawn at the same time.
    """

    pictures: int
    splats: int
    processes: int
    drawing: int

    @property
    def total(self) -> int:
        """All of it [bytes]."""
        return self.pictures + self.splats + self.processes + self.drawing

    def in_mib(self) -> dict[str, int]:
        """Return the sum, as ``total``, and the parts by their names [MiB]."""
        sizes = {"total": self.total, **asdict(self)}
        return {name: _mib(size) for name, size in sizes.items()}


def estimate(views: tuple[View, ...], preset: Preset, processes: int) -> Estimate:
    """Return what a training on these train views takes with so many processes, at its largest."""
    down = preset.data.downscale
    sizes = [(v.camera.width // down, v.camera.height // down, len(v.signals)) for v in views]
    whole = sum(_kept(3 * w * h) + n * _kept(w * h) for w, h, n in sizes)
    halved = sum(_kept(3 * (w // 2) * (h // 2)) for w, h, _ in sizes)
    tensors = 4 * (_VALUES + _HARMONICS * (preset.splats.sh_degree + 1) ** 2)
    most = preset.density.cap
    pixels = max((w * h for w, h, _ in sizes), default=0)
    return Estimate(
        pictures=min(whole + halved, preset.data.cache_mib << 20),
        splats=most * (4 * tensors + _OWN),
        processes=(processes - 1) * (_PROCESS + most * (tensors + _IN_EACH)),
        drawing=processes * pixels * _PER_PIXEL,
    )


def warning(expected: Estimate, available: int | None) -> str | None:
    """Return the sentence that says that memory may run short, None where it will not."""
    if available is None or expected.total <= available:
        return None
    parts = {"pictures": expected.pictures, "splats": expected.splats,
             "further processes": expected.processes, "drawing": expected.drawing}  # fmt: skip
    shown = ", ".join(f"{name} {_mib(size)}" for name, size in parts.items() if size)
    return (
        f"this training may take {_mib(expected.total)} MiB ({shown}), and {_mib(available)} MiB "
        "are available; lower data.cache_mib, density.cap or training.views_per_step, or raise "
        "data.downscale"
    )


def _kept(size: int) -> int:
    """Return what the picture memory takes for so many bytes."""
    return blocks(size) * BLOCK


def _mib(size: int) -> int:
    return round(size / (1 << 20))
