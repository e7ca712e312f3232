"""Lets files of this folder be found as plug-ins, each by its name, as those of the package are."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsdmsr_cli.model import layers, motion
from gsdmsr_cli.training import losses, population


@pytest.fixture(autouse=True)
def files_of_this_folder_are_plugins(monkeypatch: pytest.MonkeyPatch) -> None:
    for package in (layers, motion, losses, population):
        paths = [*package.__path__, str(Path(__file__).parent)]
        monkeypatch.setattr(package, "__path__", paths)
