"""What holds of every data folder that cannot be read."""

from __future__ import annotations

from pathlib import Path

import pytest

from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground.errors import DataError


def assert_refused(folder: Path, message: str) -> None:
    """Hold that reading the folder fails with a message of one line that names the folder."""
    with pytest.raises(DataError, match=message) as error:
        read_scene(folder)
    assert "\n" not in str(error.value) and str(folder) in str(error.value)
