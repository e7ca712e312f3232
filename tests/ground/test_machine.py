"""Where the cache lies."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsdmsr_cli.ground.machine import cache_home


@pytest.mark.parametrize("named", ["", "relative/cache"])
def test_a_cache_that_is_not_named_by_a_whole_path_lies_in_the_home(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, named: str
) -> None:
    """As the specification of XDG_CACHE_HOME has it; not wherever the command is run."""
    monkeypatch.setenv("XDG_CACHE_HOME", named)
    monkeypatch.setattr(Path, "home", lambda: tmp_path)
    assert cache_home() == tmp_path / ".cache" / "gsdmsr"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert cache_home() == tmp_path / "cache" / "gsdmsr"


def test_who_has_no_home_has_no_cache(monkeypatch: pytest.MonkeyPatch) -> None:
    def no_home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setattr(Path, "home", no_home)
    with pytest.raises(NotADirectoryError):
        cache_home().mkdir(parents=True)
