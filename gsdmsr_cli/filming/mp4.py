"""H.264 video, by the ffmpeg program where this machine has one."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from itertools import chain
from pathlib import Path
from typing import IO

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.errors import DataError, GsdmsrError, UsageError
from gsdmsr_cli.files import replacing

QUALITY = ("-crf", "18", "-preset", "veryfast")
# players take HD for BT.709 and anything else for BT.601 unless the file says which it is
_COLOURS = (
    "-vf", "scale=out_color_matrix=bt709:out_range=tv",
    "-colorspace", "bt709", "-color_primaries", "bt709", "-color_trc", "bt709",
)  # fmt: skip


def require_ffmpeg() -> str:
    """Return the ffmpeg program on PATH.

    Raises:
        UsageError: there is none.
    """
    found = shutil.which("ffmpeg")
    if found is None:
        raise UsageError(
            "--video mp4 needs the program ffmpeg, and there is none on PATH; install it or take "
            "--video webm"
        )
    return found


def write_mp4(path: Path, frames: Iterable[NDArray[np.uint8]], fps: float) -> None:
    """Write (H, W, 3) RGB frames of one size as an H.264 video, whole or not at all.

    H.264 with colours at half the resolution needs even sizes; an odd last row or column is
    doubled.

    Raises:
        UsageError: there is no ffmpeg.
        GsdmsrError: there are no frames.
        DataError: ffmpeg fails, for example because it has no H.264 encoder or the disk is full.
    """
    program = require_ffmpeg()
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise GsdmsrError(f"{path}: a video needs at least one frame")
    height, width, _ = first.shape
    size = f"{width + width % 2}x{height + height % 2}"
    with replacing(path) as beside, tempfile.TemporaryFile() as said:
        line = [
            program, "-nostdin", "-loglevel", "error", "-y", "-f", "rawvideo",
            "-pix_fmt", "rgb24", "-s", size, "-r", f"{fps:g}", "-i", "-", "-an",
            "-c:v", "libx264", "-pix_fmt", "yuv420p", *QUALITY, *_COLOURS,
            "-movflags", "+faststart", str(beside),
        ]  # fmt: skip
        _feed(line, chain([first], frames), said, path)


def _feed(
    line: list[str], frames: Iterable[NDArray[np.uint8]], said: IO[bytes], path: Path
) -> None:
    """Run ffmpeg on the frames; whatever happens, it has ended afterwards."""
    # in a session of its own: Ctrl-C is for us, who then end it
    with subprocess.Popen(
        line, stdin=subprocess.PIPE, stdout=said, stderr=said, start_new_session=True
    ) as process:
        try:
            assert process.stdin is not None
            for frame in frames:
                pad = ((0, frame.shape[0] % 2), (0, frame.shape[1] % 2), (0, 0))
                process.stdin.write(np.pad(frame, pad, mode="edge").tobytes())
            process.stdin.close()
            failed = process.wait() != 0
        except BrokenPipeError:
            failed = True
        except BaseException:
            process.kill()
            raise
    if failed:
        said.seek(0)
        words = said.read().decode(errors="replace").split("\n")
        reason = next((word.strip() for word in words if word.strip()), "it does not say why")
        raise DataError(f"{path}: cannot be written: ffmpeg: {reason}; take --video webm")
