"""Removes what stands in a run folder beside the run when the run is replaced."""

from __future__ import annotations

from pathlib import Path

from gsdmsr_cli.filming.output_files import remove_films
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.files import read_json, remove_if_empty, remove_leftovers
from gsdmsr_cli.runs.outputs import EVALUATION, FILMS, FLOW, FLOW_FILE, METRICS, PLAYED, REPORTS


def remove_results(run_folder: Path) -> None:
    """Remove what eval and render, and terms of the loss, have written into a run folder.

    Nothing else is removed.

    Raises:
        DataError: something cannot be removed.
    """
    try:
        evaluation, films = run_folder / EVALUATION, run_folder / FILMS
        if _is_folder(evaluation):
            _remove_evaluation(evaluation)
        if _is_folder(films):
            remove_films(films)
        if _is_folder(run_folder / FLOW):
            _remove_flow(run_folder / FLOW)
    except OSError as error:
        raise DataError(f"{run_folder}: cannot be emptied: {error.strerror or error}") from error


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()  # a link leads to what is not the run's


def _remove_flow(folder: Path) -> None:
    for path in folder.iterdir():
        if FLOW_FILE.fullmatch(path.name):
            path.unlink()
    remove_leftovers(folder)
    remove_if_empty(folder)


def _remove_evaluation(folder: Path) -> None:
    try:
        ours = {"schema", "protocol", "aggregate"} <= read_json(folder / METRICS).keys()
    except DataError:
        ours = False
    for name in (*REPORTS, PLAYED, METRICS) if ours else ():
        (folder / name).unlink(missing_ok=True)
    remove_leftovers(folder)
    remove_if_empty(folder)
