"""Shared fixtures: where the real data lies, and why a test that needs it is skipped."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of real data named by GSDMSR_DATA."""
    value = os.environ.get("GSDMSR_DATA")
    if not value:
        pytest.skip("GSDMSR_DATA is not set: it names the folder of real data")
    folder = Path(value)
    if not folder.is_dir():
        pytest.skip(f"GSDMSR_DATA={value} is not a folder")
    return folder.resolve()
