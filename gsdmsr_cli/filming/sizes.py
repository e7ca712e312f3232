"""Gives the cameras of a film the size that is asked for, and checks that it can be drawn."""

from __future__ import annotations

from dataclasses import replace

from gsdmsr_cli.filming.request import MOST_PIXELS, Request
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.scene.film import Film, Shot
from gsdmsr_cli.scene.scene import View


def sized(film: Film, downscale: int, request: Request) -> Film:
    """Return the film in the size that is asked for.

    Args:
        film: its cameras have the full resolution of the files.
        downscale: divisor of the pictures' sides in training.
        request: what is asked for.

    Raises:
        UsageError: the size is out of range, or differs from frame to frame, or an output cannot
            be made of the film.
    """
    shots = tuple(_sized(shot, downscale, request) for shot in film.shots)
    sizes = {(shot.camera.width, shot.camera.height) for shot in shots}
    if len(sizes) > 1:
        found = " and ".join(f"{width} x {height}" for width, height in sorted(sizes)[:2])
        raise UsageError(f"--path {film.name}: views of {found} px; give one --size WxH")
    if "flow" in request.outputs and len(shots) < 2:
        raise UsageError(f"--output flow needs two frames; --path {film.name} has one")
    if "error" in request.outputs:
        for shot in shots:
            _require_true(film.name, shot, downscale)
    return replace(film, shots=shots)


def _sized(shot: Shot, downscale: int, request: Request) -> Shot:
    camera, scale = shot.camera, request.scale or 1.0
    width, height = request.size or (
        round(camera.width / downscale * scale),
        round(camera.height / downscale * scale),
    )
    most = MOST_PIXELS // request.supersample
    if not all(1 <= side <= most for side in (width, height)):
        raise UsageError(
            f"pictures of {width} x {height} px with --supersample {request.supersample} cannot "
            f"be drawn; allowed: 1 to {most} px a side"
        )
    return replace(shot, camera=camera.framed(width, height))


def _require_true(path: str, shot: Shot, downscale: int) -> None:
    """Raise UsageError unless there is a true picture that the shot can be compared with."""
    if shot.view is None:
        raise UsageError(
            f"--output error compares with true pictures, and --path {path} shows what nobody "
            "took; take --path test, val or train, without --time"
        )
    camera = shot.camera
    plain = shot.view.camera.resized(camera.width, camera.height)
    width, height = _true_size(shot.view, downscale)
    same = (plain.fx, plain.fy) == (camera.fx, camera.fy)
    if not same or camera.width > width or camera.height > height:
        raise UsageError(
            f"--output error compares with pictures of {width} x {height} px; found "
            f"{camera.width} x {camera.height}; allowed: the same proportions, and no more"
        )


def _true_size(view: View, downscale: int) -> tuple[int, int]:
    return round(view.camera.width / downscale), round(view.camera.height / downscale)
