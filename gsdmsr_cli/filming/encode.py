"""Encodes frames as videos: VP8 in WebM, H.264 in MP4 and animated WebP, by PyAV's encoders."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.ground.errors import GsdmsrError, UsageError
from gsdmsr_cli.ground.files import replacing
from gsdmsr_cli.scene.native import load_av

Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class Encoding:
    """What a kind of video is made with.

    Attributes:
        encoder: FFmpeg's name of it.
        options: of the encoder.
        muxing: options of the container.
        most_bits: limit of the rate [bit/s], or None for none.
        pixels: FFmpeg's name of the layout of the pixels that the encoder is given.
        matrix: PyAV's name of what makes YUV of RGB.
    """

    encoder: str
    options: Mapping[str, str]
    muxing: Mapping[str, str] = field(default_factory=dict)
    most_bits: int | None = None
    pixels: str = "yuv420p"
    matrix: str = "ITU601"


ENCODINGS = {
    # VP8 aims at a quality only below a limit of the rate; of colours it knows one kind
    "webm": Encoding(
        "libvpx", {"crf": "8", "deadline": "good", "cpu-used": "5"}, most_bits=40_000_000
    ),
    # players take HD for BT.709 and anything else for BT.601 unless the file says which it is
    "mp4": Encoding(
        "libx264",
        {
            "crf": "18", "preset": "veryfast",
            "colorspace": "bt709", "color_primaries": "bt709", "color_trc": "bt709",
        },
        muxing={"movflags": "+faststart"},
        matrix="ITU709",
    ),
    # the encoder compares pictures as RGB and finds their YUV itself; 0 loops are without end
    "webp": Encoding(
        "libwebp_anim",
        {"quality": "75", "compression_level": "4"},
        muxing={"loop": "0"},
        pixels="bgra",
    ),
}  # fmt: skip
"""By the kind of video, which is also FFmpeg's name of the container."""


def require_encoder(kind: str) -> None:
    """Make sure that videos of a kind can be written.

    Raises:
        UsageError: the PyAV that is installed has no encoder for it.
    """
    encoder = ENCODINGS[kind].encoder
    if encoder not in load_av().codecs_available:
        raise UsageError(
            f"--video {kind} needs the encoder {encoder}, which the installed PyAV lacks; its "
            "wheels have it: pip install --force-reinstall --only-binary :all: av"
        )


def write_video(kind: str, path: Path, frames: Iterable[Pixels], fps: float) -> None:
    """Write (H, W, 3) RGB frames as a video of a kind of ``ENCODINGS``, whole or not at all.

    Colours are kept at half the resolution. Videos other than WebP need even sizes for that: an odd
    last row or column is doubled.

    Raises:
        UsageError: the PyAV that is installed has no encoder for it.
        GsdmsrError: there are no frames, or the encoder refuses them.
        DataError: the file cannot be written, for example because the disk is full.
        ValueError: the frames differ in size.
    """
    require_encoder(kind)
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise GsdmsrError(f"{path}: a video needs at least one frame")
    encoding, av = ENCODINGS[kind], load_av()
    with replacing(path) as beside:
        try:
            with av.open(str(beside), "w", format=kind, options=dict(encoding.muxing)) as container:
                _encode(container, encoding, chain([first], frames), first.shape, fps)
        except av.FFmpegError as error:
            if isinstance(error, OSError):
                raise
            height, width, _ = first.shape
            raise GsdmsrError(
                f"{path}: {encoding.encoder} cannot encode {width} x {height} px at {fps:g} "
                f"frames/s: {error.strerror}; change --size or --fps, or take --video none"
            ) from error


def _encode(
    container: Any,
    encoding: Encoding,
    frames: Iterable[Pixels],
    shape: tuple[int, ...],
    fps: float,
) -> None:
    frame_of = load_av().VideoFrame.from_ndarray
    height, width, _ = shape
    halved = encoding.pixels == "yuv420p"
    more = (height % 2, width % 2) if halved else (0, 0)
    rate = Fraction(fps).limit_denominator(1001)
    stream = container.add_stream(encoding.encoder, rate, options=dict(encoding.options))
    stream.width, stream.height = width + more[1], height + more[0]
    stream.pix_fmt = encoding.pixels
    if encoding.most_bits is not None:
        stream.bit_rate = encoding.most_bits
    for i, frame in enumerate(frames):
        if frame.shape != shape:
            raise ValueError(f"frame {i} has shape {frame.shape}, not {shape}")
        even = np.pad(frame, ((0, more[0]), (0, more[1]), (0, 0)), mode="edge")
        given = frame_of(np.ascontiguousarray(even), format="rgb24")
        laid_out = given.reformat(format=encoding.pixels, dst_colorspace=encoding.matrix)
        container.mux(stream.encode(laid_out))
    container.mux(stream.encode())
