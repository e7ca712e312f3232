"""gsdmsr render: draws a run to pictures, numbers and videos."""

from __future__ import annotations

from pathlib import Path

from rich.console import Console

from gsdmsr_cli.commands._progress import progress_bar
from gsdmsr_cli.commands._trained import Trained, open_trained
from gsdmsr_cli.film import Film, PathOptions
from gsdmsr_cli.filming.encode import require_encoder
from gsdmsr_cli.filming.outputs import Ends, find_ends
from gsdmsr_cli.filming.record import Reel, file_hash, shots_hash
from gsdmsr_cli.filming.request import Request
from gsdmsr_cli.filming.shoot import Account, shoot
from gsdmsr_cli.filming.sizes import sized
from gsdmsr_cli.paths import make_film

USUAL = ("test", "orbit")
"""Paths that are drawn if none is named."""


def run(run_folder: Path, request: Request, out: Path | None, data: Path | None = None) -> None:
    """Write ``PATH/0000.png`` and so on, and ``PATH.webm``, to ``out`` or else ``RUN/render``.

    Args:
        run_folder: the run.
        request: what is asked for.
        out: folder to write.
        data: where the data lies now, if not where it lay in training.

    Raises:
        UsageError: a path, view or output that does not exist, or does not go with another wish.
        DataError: the run or its data cannot be used, or a file not be written.
    """
    for kind in request.videos:
        require_encoder(kind)
    trained = open_trained(run_folder, data)
    films = [_film(trained, path, request) for path in ([request.path] if request.path else USUAL)]
    target, tools = out or run_folder / "render", _tools(trained, request)
    prepared = []
    for film in films:
        ends = find_ends(trained.studio, film.shots, request.outputs)
        reels = [_reel(film, output, target, tools, ends) for output in request.outputs]
        for reel in reels:
            reel.prepare(ours=out is None, anew=request.overwrite)
        prepared.append((film, reels, ends))
    for film, reels, ends in prepared:
        with progress_bar(f"drawing {film.name}") as tell:
            account = shoot(
                trained.studio, film, reels, ends, request.videos, request.supersample, tell
            )
        _report(film, reels, request, account)


def _film(trained: Trained, path: str, request: Request) -> Film:
    """Return the film of a path in the size that is asked for."""
    # without a path, the number of frames is for the orbit
    frames = None if request.path is None and path == "test" else request.frames
    options = PathOptions(frames, request.views)
    film = make_film(trained.scene, path, options, request.time, request.fps)
    return sized(film, trained.run.preset.data.downscale, request)


def _tools(trained: Trained, request: Request) -> dict[str, object]:
    """Return what frames depend on besides their film, for the note beside them."""
    return {
        "run": str(trained.run.root),
        "checkpoint_sha256": file_hash(trained.run.checkpoint_path),
        "background": trained.studio.background.tolist(),
        "supersample": request.supersample,
    }


def _reel(film: Film, output: str, target: Path, tools: dict[str, object], ends: Ends) -> Reel:
    first = film.shots[0].camera
    size = first.width, first.height
    count = len(film.shots) - (output == "flow")
    asked = {"path": film.name, "frames": count, "size": list(size)}
    shown = {"shots_sha256": shots_hash(film.shots), **ends.document(output)}
    name = film.name if output == "rgb" else f"{film.name}-{output}"
    return Reel(output, target, name, count, size, {**tools, **asked, **shown}, film.fps)


def _report(film: Film, reels: list[Reel], request: Request, account: Account) -> None:
    console = Console()
    for reel in reels:
        videos = " and ".join(str(reel.video(kind)) for kind in request.videos)
        beside = f"{videos} and {reel.count} pictures beside it"
        text = beside if videos else f"{reel.count} pictures to {reel.folder}"
        console.out(f"wrote {text}", highlight=False)
    console.out(_spent(film, account), highlight=False)


def _spent(film: Film, account: Account) -> str:
    camera = film.shots[0].camera
    kept = f", {account.kept} were there already" if account.kept else ""
    if not account.drawn:
        return f"nothing to draw{kept}; --overwrite draws them again"
    share = 100 * account.drawing / account.elapsed
    return (
        f"drew {account.drawn} frames of {camera.width} x {camera.height} px{kept}: "
        f"{account.elapsed:.1f} s, {share:.0f} % of it drawing"
    )
