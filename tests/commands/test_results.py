"""What goes with a run that is replaced, and what somebody else has put there, which stays."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from gsdmsr_cli.commands._results import remove_results

REPORT = {"schema": 1, "protocol": {}, "aggregate": {}}

OURS = {
    "eval/metrics.json": json.dumps(REPORT),
    "eval/report.html": "",
    "eval/report.md": "",
    "eval/play.html": "",
    f"eval/.gsdmsr-{'0f' * 16}.part.json": "",
    f"flow/{'0f' * 16}.npz": "",
    f"flow/.gsdmsr-{'0f' * 16}.part.npz": "",
    "render/orbit.film.json": '{"gsdmsr": "0.2"}',
    "render/orbit.webm": "",
    "render/orbit/0000.png": "",
    "render/orbit/0001.png": "",
}

OTHERS = {
    "eval/notes.md": "",
    "render/best.png": "",
    "render/orbit/0001.txt": "",
    "render/mine.film.json": '{"by": "me"}',
    "render/mine/0000.png": "",
    "flow/mine.npz": "",
    f"flow/{'0f' * 16}.txt": "",
    "x.ply": "",
}


def write(root: Path, files: dict[str, str]) -> None:
    for name, text in files.items():
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text)


def files_below(root: Path) -> set[str]:
    return {str(path.relative_to(root)) for path in root.rglob("*") if path.is_file()}


def test_results_go_and_nothing_else(tmp_path: Path) -> None:
    write(tmp_path, OURS | OTHERS)
    remove_results(tmp_path)
    assert files_below(tmp_path) == set(OTHERS)


def test_folders_that_are_empty_then_go_as_well(tmp_path: Path) -> None:
    write(tmp_path, OURS)
    remove_results(tmp_path)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["eval", "flow", "render"])
def test_what_a_link_leads_to_stays(tmp_path: Path, name: str) -> None:
    write(tmp_path / "elsewhere", OURS)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / name).symlink_to(tmp_path / "elsewhere" / name, target_is_directory=True)
    remove_results(tmp_path / "run")
    assert files_below(tmp_path / "elsewhere") == set(OURS)


def test_a_report_of_another_program_stays(tmp_path: Path) -> None:
    write(tmp_path, OURS | {"eval/metrics.json": '{"psnr": 3}'})
    remove_results(tmp_path)
    assert {"eval/metrics.json", "eval/report.md"} <= files_below(tmp_path)
