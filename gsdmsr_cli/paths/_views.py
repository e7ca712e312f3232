"""Finds cameras of the data: all views of one split, or one by its name."""

from __future__ import annotations

from gsdmsr_cli.ground.errors import UsageError, nearest
from gsdmsr_cli.scene.film import Shot
from gsdmsr_cli.scene.scene import Scene, View


def shots(scene: Scene, split: str) -> list[Shot]:
    """Return the views of a split in the order of time.

    Raises:
        DataError: the split has no views.
    """
    views = sorted(scene.split(split), key=lambda view: view.time)
    return [Shot(view.camera, view.time, view) for view in views]


def find_view(scene: Scene, name: str) -> View:
    """Return the view called ``name`` or, where several splits have one, ``split/name``.

    Raises:
        UsageError: there is none, or more than one.
    """
    found = [view for view in scene.views if name in (view.name, f"{view.split}/{view.name}")]
    if len(found) == 1:
        return found[0]
    if not found:
        known = {f"{view.split}/{view.name}" for view in scene.views}
        first = min(known)
        hint = nearest(name, known) if len(known) < 20 or "/" in name else f"such as '{first}'"
        raise UsageError(f"no view is called '{name}'; {hint}")
    choices = " or ".join(f"{view.split}/{view.name}" for view in found)
    raise UsageError(f"several views are called '{name}'; write {choices}")
