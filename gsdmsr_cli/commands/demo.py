"""gsdmsr demo: makes a small moving scene, reconstructs it and renders the result."""

from __future__ import annotations

import shlex
from pathlib import Path

from gsdmsr_cli.commands import eval as evaluate
from gsdmsr_cli.commands import render, train
from gsdmsr_cli.commands._progress import progress_bar
from gsdmsr_cli.demo.synthetic import write_scene
from gsdmsr_cli.evaluation.request import Output
from gsdmsr_cli.filming.request import Request as FilmRequest
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.locks import sole_writer
from gsdmsr_cli.runs.outputs import EVALUATION, METRICS, PLAYED, REPORTS
from gsdmsr_cli.training.request import Request

BUDGET = "60s"
"""Wall time of the training; with everything else the demo stays under 3 minutes on 2 cores."""

MARKER = ".gsdmsr-demo"
"""File that marks a folder as an earlier demo, which may be replaced."""


def run(out: Path) -> None:
    """Write the scene to ``out/scene`` and its reconstruction to ``out/run``.

    Raises:
        UsageError: ``out`` is a file, or a folder with something else in it.
        DataError: ``out`` cannot be written, or another process writes there.
    """
    _claim(out)
    scene, run_folder = out / "scene", out / "run"
    with sole_writer(out), say.parts() as answers:
        _write_scene(scene)
        named = scene, run_folder, "dnerf", None, (f"training.budget={BUDGET}",)
        train.run(Request(*named, overwrite=run_folder.exists()))
        evaluate.run(run_folder, None, None, Output(report=True, play=True))
        render.run(run_folder, FilmRequest(), None)
    parts = dict(zip(("train", "eval", "render"), answers, strict=False))
    places = _places(scene, run_folder)
    say.result({"places": places, **parts}, _where_to_look(places, run_folder))


def _claim(out: Path) -> None:
    """Make ``out`` a demo's folder, unless something else lies there."""
    if out.exists() and not out.is_dir():
        raise UsageError(f"{out}: is a file; --out names a folder")
    if out.is_dir() and any(out.iterdir()) and not (out / MARKER).is_file():
        raise UsageError(f"{out}: is neither empty nor an earlier demo; choose another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
        (out / MARKER).touch()
    except OSError as error:
        reason = error.strerror or error
        raise DataError(f"{out}: cannot be made: {reason}; choose another --out") from error


def _write_scene(folder: Path) -> None:
    with sole_writer(folder), progress_bar("drawing the scene") as on_progress:
        write_scene(folder, progress=on_progress)


def _places(scene: Path, run_folder: Path) -> list[tuple[str, str]]:
    """Return what there is to look at, and where."""
    places = [("the pictures it was trained on", scene / "train")]
    places += [("video", path) for path in sorted(run_folder.rglob("*.webm"))]
    places += [("scores", run_folder / EVALUATION / METRICS)]
    places += [("report, for a browser", run_folder / EVALUATION / REPORTS[1])]
    places += [("the scene to move about in, for a browser", run_folder / EVALUATION / PLAYED)]
    return [(what, str(path)) for what, path in places]


def _where_to_look(places: list[tuple[str, str]], run_folder: Path) -> str:
    lines = [f"  {what}: {path}" for what, path in places]
    folder = shlex.quote(str(run_folder))
    export = f"gsdmsr export {folder} --format ply --time 0.5 --out half.ply"
    return "\n".join(["Files to open", *lines, f"  for a splat viewer: {export}"])
