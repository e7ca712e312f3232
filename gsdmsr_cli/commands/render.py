"""gsdmsr render: renders a trained model along camera paths to pictures, numbers and videos."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

from gsdmsr_cli.commands._progress import progress_bar
from gsdmsr_cli.commands._trained import Trained, open_trained
from gsdmsr_cli.drawing.middle import middle
from gsdmsr_cli.filming.draw_film import Timings, draw_film
from gsdmsr_cli.filming.encode import require_encoder
from gsdmsr_cli.filming.output_files import OutputFiles, shots_hash
from gsdmsr_cli.filming.outputs import ColourRange, find_colour_range
from gsdmsr_cli.filming.request import Request
from gsdmsr_cli.filming.sizes import sized
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.files import require_folder
from gsdmsr_cli.ground.locks import one_of_readers, sole_writer
from gsdmsr_cli.paths import faces_centre, make_film
from gsdmsr_cli.runs.outputs import FILMS
from gsdmsr_cli.scene.film import ORIGIN, Film, PathOptions

USUAL = ("test", "orbit")
"""Paths that are drawn if none is named."""

LOOKED_AT = 16
"""Most train views, evenly spaced in time, in which the middle of what they show is looked for."""


def run(run_folder: Path, request: Request, out: Path | None, data: Path | None = None) -> None:
    """Write ``PATH/0000.png`` and so on, and ``PATH.webm``, to ``out`` or else ``RUN/render``.

    Args:
        run_folder: the run.
        request: what is asked for.
        out: folder to write.
        data: where the data lies now, if not where it lay in training.

    Raises:
        UsageError: a path, view or output that does not exist, or contradicts another option.
        DataError: the run or its data cannot be used, or a file not be written.
    """
    for kind in request.videos:
        require_encoder(kind)
    with ExitStack() as held:
        trained = held.enter_context(open_trained(run_folder, data))
        _draw(trained, request, out, held)


def _draw(trained: Trained, request: Request, out: Path | None, held: ExitStack) -> None:
    """Draw all films, whose folders are ``held`` meanwhile."""
    films = [_film(trained, path, request) for path in ([request.path] if request.path else USUAL)]
    target, origin = out or trained.run.results / FILMS, _origin(trained, request)
    prepared = []
    require_folder(target)
    held.enter_context(one_of_readers(target))
    for film in films:
        colours = find_colour_range(trained.renderer, film.shots, request.outputs)
        outputs = [
            _output_files(film, output, target, origin, colours) for output in request.outputs
        ]
        for files in outputs:
            held.enter_context(sole_writer(files.folder))
            files.prepare(replaceable=out is None, anew=request.overwrite)
        prepared.append((film, outputs, colours))
    drawn = []
    for film, outputs, colours in prepared:
        with progress_bar(f"drawing {film.name}") as on_progress:
            timings = draw_film(
                trained.renderer,
                film,
                outputs,
                colours,
                request.videos,
                request.supersample,
                on_progress,
            )
        drawn.append((film, outputs, timings))
    document = {"films": [_document(*one, request) for one in drawn]}
    say.result(document, *(line for one in drawn for line in _lines(*one, request)))


def _film(trained: Trained, path: str, request: Request) -> Film:
    """Return the film of a path in the size that is asked for."""
    # without a path, the number of frames is for the orbit
    frames = None if request.path is None and path == "test" else request.frames
    centre = _middle(trained) if faces_centre(path) else ORIGIN
    options = PathOptions(frames, request.views, centre)
    film = make_film(trained.scene, path, options, request.time, request.fps)
    return sized(film, trained.run.preset.data.downscale, request)


def _middle(trained: Trained) -> tuple[float, float, float]:
    """Return the middle of what the run shows [world units], the origin if there is no telling."""
    views = sorted(trained.scene.split("train"), key=lambda view: view.time)
    shots = [(view.camera, view.time) for view in views[:: -(-len(views) // LOOKED_AT)]]
    point = middle(trained.renderer.model, shots, trained.renderer.engine)
    if point is None:
        return ORIGIN
    x, y, z = point.tolist()
    return x, y, z


def _origin(trained: Trained, request: Request) -> dict[str, object]:
    """Return what frames depend on besides their film, for the JSON file beside them."""
    return {
        "run": str(trained.run.root),
        "checkpoint_sha256": trained.checkpoint.sha256,
        "background": trained.renderer.background.tolist(),
        "supersample": request.supersample,
    }


def _output_files(
    film: Film, output: str, target: Path, origin: dict[str, object], colours: ColourRange
) -> OutputFiles:
    first = film.shots[0].camera
    size = first.width, first.height
    count = len(film.shots) - (output == "flow")
    asked = {"path": film.name, "frames": count, "size": list(size)}
    shown = {"shots_sha256": shots_hash(film.shots), **colours.document(output)}
    name = film.name if output == "rgb" else f"{film.name}-{output}"
    return OutputFiles(output, target, name, count, size, {**origin, **asked, **shown}, film.fps)


def _document(
    film: Film, outputs: list[OutputFiles], timings: Timings, request: Request
) -> dict[str, Any]:
    return {
        "path": film.name,
        "outputs": [
            {
                "output": files.output,
                "folder": str(files.folder),
                "frames": files.count,
                "size": list(files.size),
                "videos": [str(files.video(kind)) for kind in request.videos],
            }
            for files in outputs
        ],
        "drawn": timings.drawn,
        "kept": timings.kept,
        "drawing_s": round(timings.drawing, 3),
        "elapsed_s": round(timings.elapsed, 3),
    }


def _lines(
    film: Film, outputs: list[OutputFiles], timings: Timings, request: Request
) -> Iterator[str]:
    for files in outputs:
        videos = " and ".join(str(files.video(kind)) for kind in request.videos)
        beside = f"{videos} and {files.count} pictures beside it"
        text = beside if videos else f"{files.count} pictures to {files.folder}"
        yield f"wrote {text}"
    yield _spent(film, timings)


def _spent(film: Film, timings: Timings) -> str:
    camera = film.shots[0].camera
    kept = f", {timings.kept} were there already" if timings.kept else ""
    if not timings.drawn:
        return f"nothing to draw{kept}; --overwrite draws them again"
    share = 100 * timings.drawing / timings.elapsed
    return (
        f"drew {timings.drawn} frames of {camera.width} x {camera.height} px{kept}: "
        f"{timings.elapsed:.1f} s, {share:.0f} % of it drawing"
    )
