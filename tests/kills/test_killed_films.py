"""Films whose drawing is killed, or finds the disk full, at changes and bytes of their files."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import films
import killed
import pytest

from gsdmsr_cli.cli.main import main
from gsdmsr_cli.commands import render as command

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="kills, and limits of files")

POINTS = 5
"""Kills, and full disks, that are spread over all changes of the disk."""


@pytest.fixture(scope="module")
def run(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return films.make_run(tiny_scene, tmp_path_factory.mktemp("killed") / "run")


@pytest.fixture(scope="module")
def draw(run: Path) -> Callable[..., killed.Ended]:
    """``gsdmsr render`` to a folder, with or without a kill or a full disk."""
    return lambda out, *how: killed.run(["render", run, *films.FILM, "--out", out], out, *how)


@pytest.fixture(scope="module")
def undisturbed(draw: Callable[..., killed.Ended], run: Path) -> tuple[int, Path]:
    """How many changes of the disk a film makes, and the film."""
    ended = draw(run.parent / "undisturbed")
    assert ended.code == 0, ended.said
    return ended.changes, run.parent / "undisturbed"


def spread(count: int) -> Iterator[int]:
    return (1 + i * (count - 1) // (POINTS - 1) for i in range(POINTS))


def assert_whole(out: Path, expected: Path) -> int:
    """Hold all that has its final name to being what it is in the end; return how much there is."""
    found = films.shown(out)
    assert found.items() <= films.shown(expected).items()
    return len(found)


def test_a_film_that_is_killed_at_any_change_is_gone_on_with(
    draw: Callable[..., killed.Ended], undisturbed: tuple[int, Path], tmp_path: Path
) -> None:
    changes, expected = undisturbed
    there = []
    for number in spread(changes):
        out = tmp_path / str(number)
        assert draw(out, number).killed
        there.append(assert_whole(out, expected))
        again = draw(out)
        assert again.code == 0, again.said
        assert films.names(out) == films.names(expected)
        assert films.shown(out) == films.shown(expected)
    assert there[0] == 0 < there[-1] and changes > 50


def test_a_disk_that_is_full_from_any_change_on_is_told(
    draw: Callable[..., killed.Ended], undisturbed: tuple[int, Path], tmp_path: Path
) -> None:
    changes, expected = undisturbed
    for number in spread(changes - POINTS):
        out = tmp_path / str(number)
        ended = draw(out, number, True)
        assert ended.code == 3, ended.said
        assert "error: " in ended.said and "No space left on device" in ended.said
        assert ended.said.count("\n") == 1, ended.said
        assert_whole(out, expected)
        assert not list(tmp_path.rglob("*.part*"))


@pytest.fixture
def limit_files(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[int], None]]:
    """Let no file of this process grow beyond so many bytes, from where it begins to write.

    So it is on a full disk; memory that is mapped before is limited in the same way.
    """
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    require = command.require_folder

    def limit(size: int) -> None:
        def require_and_limit(folder: Path) -> None:
            require(folder)
            resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))

        monkeypatch.setattr(command, "require_folder", require_and_limit)

    yield limit
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("share", [0.0, 0.05, 0.3, 0.6, 0.9, 0.999])
def test_a_film_whose_files_end_at_any_byte_is_told(
    run: Path, undisturbed: tuple[int, Path], tmp_path: Path, share: float, limit_files: Any,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Up to the size of the largest: first notes fail, then pictures, at last numbers."""
    out, expected = tmp_path / "out", undisturbed[1]
    largest = max(path.stat().st_size for path in expected.rglob("*") if path.is_file())
    words = ["gsdmsr", "render", run, *films.FILM, "--out", out]
    monkeypatch.setattr(sys, "argv", [*map(str, words)])
    monkeypatch.delenv("GSDMSR_DEBUG", raising=False)
    limit_files(int(share * largest))
    with pytest.raises(SystemExit) as ended:
        main()
    said = capsys.readouterr().err
    assert ended.value.code == 3, said
    assert said.startswith("error: ") and said.endswith("is the disk full?\n"), said
    assert "cannot be written: " in said and said.count("\n") == 1
    assert_whole(out, expected)
    assert not list(tmp_path.rglob("*.part*"))
