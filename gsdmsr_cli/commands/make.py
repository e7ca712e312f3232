"""gsdmsr make: everything from a video to a page that plays, stage by stage.

What a stage has finished is not done again by the same command, and what it has begun goes on.
"""

from __future__ import annotations

import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

from gsdmsr_cli.capture.options import Options
from gsdmsr_cli.capture.publish import is_scene
from gsdmsr_cli.commands import eval as evaluate
from gsdmsr_cli.commands import prepare, render, train
from gsdmsr_cli.commands._beginning import is_complete
from gsdmsr_cli.commands._making import Making, Request
from gsdmsr_cli.evaluation.request import Output
from gsdmsr_cli.filming.request import Request as FilmRequest
from gsdmsr_cli.formats import read_scene, recognised
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.files import read_json
from gsdmsr_cli.ground.locks import sole_writer
from gsdmsr_cli.options.preset import load_preset
from gsdmsr_cli.runs.outputs import EVALUATION, FILMS, METRICS, PLAYED, REPORTS
from gsdmsr_cli.runs.run import is_run, open_run
from gsdmsr_cli.training.request import Request as TrainRequest


def run(request: Request) -> None:
    """Make ``OUT/scene``, ``OUT/run`` and all that is looked at, as far as it is not there.

    Raises:
        UsageError: OUT holds something else, or an option does not exist.
        DataError: the input cannot be used, OUT not be written, or another process writes there.
        KeyboardInterrupt: Ctrl-C; what is finished is kept for the same command.
    """
    options = load_preset(request.preset, None, _overrides(request))  # an error now, not later
    if options.segments.several:
        raise UsageError(
            f"segments.count is {options.segments.count}; allowed for make: 1, since its page "
            "plays one model; take train --segments"
        )
    making = Making(request)
    making.claim()
    with sole_writer(request.out), say.parts():
        making.begin()
        try:
            _make(request, making)
        except KeyboardInterrupt:
            say.note(f"interrupted; the same command goes on in {shlex.quote(str(request.out))}")
            raise
    _tell(request)


def _make(request: Request, making: Making) -> None:
    data, folder = request.given, request.out / "run"
    prepared = not recognised(request.given)
    if prepared:
        data = request.out / "scene"
        if not is_scene(data):
            options = Options(frames=request.frames, max_side=request.max_side)
            prepare.run(request.given, data, None, None, options, overwrite=False, keep=False)
    _train(request, data, folder)
    checkpoint = open_run(folder).load().sha256
    if making.is_to_do("eval", checkpoint, folder / EVALUATION / METRICS):
        evaluate.run(folder, None, None, Output(report=True, play=True))
        making.done("eval", checkpoint)
    if making.is_to_do("render", checkpoint, folder / FILMS):
        for film in _films_of_a_video(data) if prepared else [FilmRequest()]:
            render.run(folder, film, None)
        making.done("render", checkpoint)


def _films_of_a_video(scene: Path) -> list[FilmRequest]:
    """Return the camera's own way, and how time goes by before the one in its middle."""
    views = sorted(read_scene(scene).split("train"), key=lambda view: view.time)
    middle = views[len(views) // 2]
    return [FilmRequest("train"), FilmRequest("still", views=(f"train/{middle.name}",))]


def _train(request: Request, data: Path, folder: Path) -> None:
    """Train as long as is asked for, on from what there is."""
    overrides = _overrides(request)
    asked = TrainRequest(data, folder, request.preset, None, overrides, request.device)
    if not is_run(folder):
        train.run(replace(asked, overwrite=folder.exists()))
        return
    earlier = open_run(folder)
    length = replace(earlier.preset.training, budget=request.budget)
    if not is_complete(earlier, earlier.load_whole()[0], length):
        train.run(replace(asked, preset=None, overrides=overrides[-1:], resume=True))


def _overrides(request: Request) -> tuple[str, ...]:
    """Return all options that differ from the preset; the last is the length."""
    return *request.overrides, f"training.budget={json.dumps(request.budget)}"


def _tell(request: Request) -> None:
    """Print the figures, and where there is something to look at."""
    folder = request.out / "run"
    metrics: dict[str, Any] = read_json(folder / EVALUATION / METRICS)
    places = [("film", path) for path in sorted((folder / FILMS).glob("*.webm"))]
    places += [("report, for a browser", folder / EVALUATION / REPORTS[1])]
    places += [("the scene to move about in, for a browser", folder / EVALUATION / PLAYED)]
    shown = [(what, str(path)) for what, path in places]
    scores = metrics["aggregate"]
    figures = f"{len(metrics['frames'])} held-out views: PSNR {scores['psnr']:.2f} dB, SSIM "
    lines = [f"  {what}: {path}" for what, path in shown]
    say.result(
        {"run": str(folder), "places": shown, "aggregate": scores},
        f"{figures}{scores['ssim']:.4f}",
        "\n".join(["Files to open", *lines]),
    )
