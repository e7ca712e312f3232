"""Makes camera paths, along which a trained scene is rendered: one module per path.

A path is a module of this package with ``TAKES: frozenset[str]``, which of the fields of
``PathOptions`` it takes, and::

    def shots(scene: Scene, options: PathOptions) -> list[Shot]
        # with cameras at the full resolution of the scene's files

Beside them there are the views of each split, and the files of keyframes that users write. Paths
never import one another; what they share lies in files with a leading underscore.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from gsdmsr_cli.ground import plugins
from gsdmsr_cli.ground.errors import UsageError, nearest
from gsdmsr_cli.paths import _keyframes, _views
from gsdmsr_cli.scene.film import MADE_FPS, VIEWS_FPS, Film, PathOptions, Shot
from gsdmsr_cli.scene.scene import SPLITS, Scene


def path_names() -> list[str]:
    """Return the names of all paths but files of keyframes."""
    return sorted([*SPLITS, *plugins.names(__name__)])


def faces_centre(path: str) -> bool:
    """Return whether a path's cameras go round ``PathOptions.centre``; not if there is no such."""
    made = path not in SPLITS and path in path_names()
    return made and "centre" in plugins.load(__name__, path).TAKES


def make_film(
    scene: Scene,
    path: str,
    options: PathOptions,
    time: float | None = None,
    fps: float | None = None,
) -> Film:
    """Return the film of a path through the scene.

    Args:
        scene: its cameras say where one can stand.
        path: one of ``path_names()``, or a file of keyframes, ``*.json``.
        options: what is asked of the path.
        time: the moment at which time stands still, in [0, 1]; None lets the path say.
        fps: frames a second, if not the path's own.

    Raises:
        UsageError: there is no such path, or it does not take such an option.
        DataError: the split has no views, or the file of keyframes cannot be used.
    """
    known = path_names()
    if path in SPLITS:
        _refuse(path, options, frozenset(), ": its frames are the views that there are")
        film = Film(path, tuple(_views.shots(scene, path)), VIEWS_FPS)
    elif path.endswith(".json"):
        _refuse(path, options, frozenset({"frames"}), ": its keyframes name the views")
        film = _keyframes.film(scene, Path(path), options.frames, fps)
    elif path in known:
        module = plugins.load(__name__, path)
        _refuse(path, options, module.TAKES, "")
        film = Film(path, tuple(module.shots(scene, options)), MADE_FPS)
    else:
        raise UsageError(f"unknown path '{path}'; {nearest(path, known)}; or a FILE.json")
    shots = film.shots if time is None else tuple(_frozen(shot, time) for shot in film.shots)
    return replace(film, shots=shots, fps=fps or film.fps)


def _refuse(path: str, options: PathOptions, takes: frozenset[str], why: str) -> None:
    """Raise UsageError if an option is given that the path does not take."""
    given = {"frames": options.frames is not None, "views": bool(options.views)}
    flags = {"frames": "--frames", "views": "--view"}
    for name, there in given.items():
        if there and name not in takes:
            raise UsageError(f"{flags[name]} is not for --path {path}{why}; drop it")


def _frozen(shot: Shot, time: float) -> Shot:
    return shot if shot.time == time else Shot(shot.camera, time)
