"""Turns what is rendered of a frame into the picture of an output, such as depth in colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.evaluation.protocol import ViewRenderer
from gsdmsr_cli.filming.buffers import BufferRenderer, Buffers, Floats
from gsdmsr_cli.scene.film import Shot
from gsdmsr_cli.scene.imaging import colour_wheel, eight_bits, turbo

Pixels = NDArray[np.uint8]

CHANNELS = {"depth": ("Z",), "flow": ("u", "v")}
"""Outputs that are also written as float32 EXR, with the names of its channels."""

FULL_ERROR = 0.25
"""Mean absolute difference of the colours at which the error's colours end."""

SAMPLES, SAMPLE_SIDE = 8, 128
"""How many frames, and how large [px], are drawn to find the range of the colours."""


@dataclass(frozen=True)
class ColourRange:
    """Range of the colour maps, one for all frames of a film, which would flicker otherwise.

    Attributes:
        near, far: depths [world units].
        fast: length of the flow, over the picture's larger side.
    """

    near: float = 0.0
    far: float = 1.0
    fast: float = 1.0

    def document(self, output: str) -> dict[str, Any]:
        """Return the numbers that concern an output, to be written beside it."""
        concern = {"depth": ("near", "far"), "flow": ("fast",)}.get(output, ())
        return {key: value for key, value in asdict(self).items() if key in concern}


def picture(output: str, buffers: Buffers, colours: ColourRange, true: Floats | None) -> Pixels:
    """Return the (H, W, 1 | 3) picture of an output.

    Args:
        output: its name.
        buffers: what has been rendered.
        colours: range of the colour map.
        true: (H, W, 3) the true picture in [0, 1]; only the error needs it.
    """
    if output == "rgb":
        return eight_bits(buffers.rgb)
    if output == "alpha":
        return eight_bits(buffers.alpha[..., None])
    if output == "depth":
        return _depth(buffers, colours)
    if output == "flow":
        assert buffers.flow is not None
        fastest = np.float32(colours.fast * max(buffers.alpha.shape))
        return colour_wheel(buffers.flow / fastest * buffers.alpha[..., None])
    assert output == "error" and true is not None
    return error_colours(eight_bits(buffers.rgb), true, FULL_ERROR)


def error_colours(drawn: Pixels, true: Floats, full: float) -> Pixels:
    """Return how far colours are apart on average, from blue at 0 to red at ``full``.

    Args:
        drawn: (H, W, 3) the drawn picture.
        true: (H, W, 3) the true one in [0, 1].
        full: mean absolute difference at which the colours end.
    """
    return turbo(np.abs(drawn.astype(np.float32) / 255 - true).mean(2) / np.float32(full))


def numbers(output: str, buffers: Buffers) -> Floats:
    """Return the (H, W, C) numbers of an output in ``CHANNELS``."""
    if output == "depth":
        return buffers.expected_depth[..., None]
    assert output == "flow" and buffers.flow is not None
    return buffers.flow


def find_colour_range(
    renderer: ViewRenderer, shots: Sequence[Shot], outputs: Sequence[str]
) -> ColourRange:
    """Return the range of the colours for a whole film, from some of its frames, drawn small.

    Depths end where 1 % of what is seen lies nearer or farther, the flow where 1 % is faster.
    """
    wanted = set(CHANNELS) & set(outputs)
    chosen = range(0, len(shots), -(-len(shots) // SAMPLES))
    if not wanted:
        return ColourRange()
    buffer_renderer, depths, speeds = BufferRenderer(renderer, 1, wanted), [], []
    for i in chosen:
        following = _small(shots[i + 1]) if i + 1 < len(shots) else None
        buffers = buffer_renderer.draw(_small(shots[i]), following)
        solid = buffers.alpha > 0.5
        if buffers.depth is not None:
            depths.append(buffers.expected_depth[solid])
        if buffers.flow is not None:
            speeds.append(np.linalg.norm(buffers.flow[solid], axis=1) / max(buffers.alpha.shape))
    near, far = _percentiles(depths, (1, 99), (0.0, 1.0))
    (fast,) = _percentiles(speeds, (99,), (1.0,))
    return ColourRange(near, max(far, near + 1e-3), max(fast, 1e-6))


def _small(shot: Shot) -> Shot:
    camera = shot.camera
    scale = min(1.0, SAMPLE_SIDE / max(camera.width, camera.height))
    size = max(1, round(camera.width * scale)), max(1, round(camera.height * scale))
    return replace(shot, camera=camera.resized(*size))


def _percentiles(
    parts: list[Floats], percents: tuple[int, ...], otherwise: tuple[float, ...]
) -> tuple[float, ...]:
    values = np.concatenate(parts) if parts else np.zeros(0)
    if not len(values):
        return otherwise
    return tuple(float(value) for value in np.percentile(values, percents))


def _depth(buffers: Buffers, colours: ColourRange) -> Pixels:
    """Near is warm, far is cold, what is not seen is black."""
    depth = np.minimum(buffers.expected_depth, np.float32(colours.far))  # which may be infinite
    nearness = (np.float32(colours.far) - depth) / np.float32(colours.far - colours.near)
    shade = buffers.alpha.clip(0, 1)[..., None]
    return np.asarray(np.rint(turbo(nearness) * shade), dtype=np.uint8)
