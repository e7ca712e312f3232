"""Removes what eval and render have written into a run folder when the run is replaced."""

from __future__ import annotations

from pathlib import Path

from gsdmsr_cli.filming.output_files import remove_films
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import read_json, remove_if_empty, remove_leftovers
from gsdmsr_cli.runs.outputs import EVALUATION, FILMS, METRICS, REPORTS


def remove_results(run_folder: Path) -> None:
    """Remove what eval and render have written into a run folder, and nothing else.

    Raises:
        DataError: something cannot be removed.
    """
    try:
        evaluation, films = run_folder / EVALUATION, run_folder / FILMS
        if _is_folder(evaluation):
            _remove_evaluation(evaluation)
        if _is_folder(films):
            remove_films(films)
    except OSError as error:
        raise DataError(f"{run_folder}: cannot be emptied: {error.strerror or error}") from error


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()  # a link leads to what is not the run's


def _remove_evaluation(folder: Path) -> None:
    try:
        ours = {"schema", "protocol", "aggregate"} <= read_json(folder / METRICS).keys()
    except DataError:
        ours = False
    for name in (*REPORTS, METRICS) if ours else ():
        (folder / name).unlink(missing_ok=True)
    remove_leftovers(folder)
    remove_if_empty(folder)
