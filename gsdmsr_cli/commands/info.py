"""gsdmsr info: says what lies at a path, and whether it is sound."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from gsdmsr_cli.capture.source import VIDEOS, find_source
from gsdmsr_cli.commands._found import Found
from gsdmsr_cli.formats import recognised
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.printing import one_line

KNOWN = (
    "a run, a scene, a video, a folder of pictures or videos, a PLY file or a folder of them, "
    "or a metrics.json of eval"
)


def run(path: Path) -> None:
    """Print what lies at ``path``; it is only read.

    Raises:
        DataError: there is nothing, nothing that is known, or it is not sound.
    """
    found = look_at(path)
    document = {"path": str(path), "kind": found.kind, "sound": found.sound}
    document |= {"facts": dict(found.facts), "problems": list(found.problems)}
    verdict = "sound" if found.sound else "not sound"
    problems = (f"problem: {one_line(problem)}" for problem in found.problems)
    say.result(document, f"{path}: {found.kind}, {verdict}", _table(found.facts), *problems)
    if not found.sound:
        more = f", and {len(found.problems) - 1} more" if len(found.problems) > 1 else ""
        raise DataError(f"{path}: this {found.kind} is not sound: {found.problems[0]}{more}")


def look_at(path: Path) -> Found:
    """Return what lies at a path.

    Raises:
        DataError: there is nothing, or nothing that is known.
    """
    if path.is_file():
        return _file(path)
    if path.is_dir():
        return _folder(path)
    raise DataError(f"{path}: there is nothing; give the path of {KNOWN}")


def _file(path: Path) -> Found:
    from gsdmsr_cli.commands import _info_files as files
    from gsdmsr_cli.runs.moving_file import is_moving_file

    if is_moving_file(path):
        from gsdmsr_cli.commands._info_run import run_found

        return run_found(path)
    suffix = path.suffix.lower()
    if suffix == ".ply":
        return files.ply_found(path)
    if suffix == ".json":
        return files.report_found(path)
    if suffix in VIDEOS:
        return files.video_found(path)
    raise DataError(f"{path}: is no file that gsdmsr knows by its name; give {KNOWN}")


def _folder(path: Path) -> Found:
    from gsdmsr_cli.runs.run import is_run

    if is_run(path):
        from gsdmsr_cli.commands._info_run import run_found

        return run_found(path)
    if recognised(path):
        from gsdmsr_cli.commands._info_scene import scene_found

        return scene_found(path)
    from gsdmsr_cli.commands import _info_files as files

    plys = sorted(path.glob("*.ply"))
    if plys:
        return files.sequence_found(path, plys)
    try:
        source = find_source(path)
    except DataError as error:
        raise DataError(f"{path}: is nothing that gsdmsr knows; give {KNOWN}") from error
    return files.source_found(source)


def _table(facts: Mapping[str, Any]) -> Table:
    table = Table(show_header=False)
    for name, value in facts.items():
        table.add_row(name.replace("_", " "), escape(one_line(_shown(value))))
    return table


def _shown(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {_shown(own)}" for name, own in value.items()) or "none"
    if isinstance(value, list):
        return ", ".join(map(_shown, value)) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.6g}"
    return "none" if value is None else str(value)
