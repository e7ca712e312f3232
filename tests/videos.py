"""Videos for tests, written by PyAV in any codec and with any times."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest

TICKS = 600
"""Times are in this part of a second."""


def write_video(
    path: Path,
    pictures: Sequence[np.ndarray],
    codec: str = "libx264",
    format: str = "yuv420p",
    ticks: Sequence[int] | None = None,
    options: dict[str, str] | None = None,
) -> Path:
    """Write (H, W, 3) pictures, 30 a second or at these times; skip without the encoder.

    Args:
        path: the file.
        pictures: in their order.
        codec: FFmpeg's name of the encoder.
        format: FFmpeg's name of how pixels are stored, such as "yuv420p10le".
        ticks: when each is shown, in parts of a second.
        options: of the encoder.
    """
    try:
        av.codec.Codec(codec, "w")
    except av.codec.codec.UnknownCodecError:
        pytest.skip(f"this FFmpeg has no encoder {codec}")
    height, width = pictures[0].shape[:2]
    with av.open(str(path), "w") as out:
        stream = out.add_stream(codec, rate=30, options=options or {})
        stream.width, stream.height, stream.pix_fmt = width, height, format
        stream.codec_context.time_base = Fraction(1, TICKS)
        for i, picture in enumerate(pictures):
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame.pts = i * TICKS // 30 if ticks is None else int(ticks[i])
            frame.time_base = Fraction(1, TICKS)
            out.mux(stream.encode(frame))
        out.mux(stream.encode())
    return path
