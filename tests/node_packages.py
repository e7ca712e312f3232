"""Readers of others that are packages of Node.js; tests that want one are skipped without it."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

VARIABLE = "GSDMSR_NODE_MODULES"

PATIENCE = 120.0
"""Longest that a script may take [s]."""


def package(name: str) -> Path:
    """Return the folder of a package, or skip the test."""
    folder = Path(os.environ.get(VARIABLE, "node_modules")) / name
    if shutil.which("node") is None or not folder.is_dir():
        pytest.skip(f"no {name}: npm install {name} --ignore-scripts, {VARIABLE}=.../node_modules")
    return folder.resolve()


def node(*words: object) -> str:
    """Run Node.js and return what it has printed."""
    done = subprocess.run(
        ["node", *map(str, words)], capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
