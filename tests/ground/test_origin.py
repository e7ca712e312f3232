"""The commit that a version comes from: of a clone, of what was built from one, of neither."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from gsdmsr_cli import __version__
from gsdmsr_cli.ground import origin

pytestmark = pytest.mark.skipif(shutil.which("git") is None, reason="git is not installed")

ROOT = Path(__file__).parents[2]


def git(clone: Path, *line: str) -> str:
    who = ("-c", "user.name=a", "-c", "user.email=a@b.c", "-c", "commit.gpgsign=false")
    command = ["git", "-C", str(clone), *who, *line]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def commit_all(clone: Path) -> str:
    """Make a clone of a folder and return its commit."""
    git(clone, "init", "--quiet")
    git(clone, "add", "--all")
    git(clone, "commit", "--quiet", "--message", "all")
    return git(clone, "rev-parse", "--short=10", "HEAD")


def test_a_clone_names_its_commit_and_whether_it_was_changed(tmp_path: Path) -> None:
    (tmp_path / "a").write_text("1")
    assert origin.describe(tmp_path) is None
    expected = commit_all(tmp_path)
    git(tmp_path, "tag", "--annotate", "v9", "--message", "a tag does not hide the commit")
    assert origin.describe(tmp_path) == expected
    (tmp_path / "a").write_text("2")
    assert origin.describe(tmp_path) == f"{expected}-dirty"


def test_a_folder_inside_another_clone_is_not_taken_for_it(tmp_path: Path) -> None:
    (tmp_path / "site-packages").mkdir()
    (tmp_path / "site-packages" / "a").touch()
    commit_all(tmp_path)
    assert origin.describe(tmp_path / "site-packages") is None


def test_what_was_built_from_a_clone_carries_its_commit(tmp_path: Path) -> None:
    pytest.importorskip("setuptools")
    source, built = tmp_path / "source", tmp_path / "built"
    for folder in ("gsdmsr_cli", "presets"):
        shutil.copytree(ROOT / folder, source / folder, ignore=lambda *_: ["__pycache__"])
    for name in ("setup.py", "pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    expected = commit_all(source)
    line = ["setup.py", "--quiet", "build_py", "--build-lib", str(built)]
    subprocess.run([sys.executable, *line], cwd=source, check=True, capture_output=True)
    line = ["-m", "gsdmsr_cli", "--version"]
    done = subprocess.run([sys.executable, *line], cwd=built, check=True, capture_output=True)
    place = built / "gsdmsr_cli"
    assert done.stdout.decode() == f"gsdmsr {__version__} (commit {expected}, {place})\n"
