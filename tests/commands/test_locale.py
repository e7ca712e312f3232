"""Names outside ASCII where the terminal has ASCII alone: commands work and files are UTF-8."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gsdmsr_cli.demo.synthetic import write_scene

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="no locales of this kind there")

CALLS = """
import json, sys
from gsdmsr_cli.cli.main import main
from gsdmsr_cli.evaluation import speed

speed.SECONDS = 0.01
for arguments in json.loads(sys.argv[1]):
    sys.argv = ["gsdmsr", *arguments]
    try:
        main()
    except SystemExit as ended:
        if ended.code:
            sys.exit(f"{arguments}: {ended.code}")
"""


def in_ascii(arguments: list[str], **further: str) -> subprocess.CompletedProcess[bytes]:
    plain = {"LC_ALL": "C", "PYTHONIOENCODING": "ascii", "COLUMNS": "300"}
    free = {name: value for name, value in os.environ.items() if name != "PYTHONUTF8"}
    command = [sys.executable, *arguments]
    return subprocess.run(command, env=free | plain | further, capture_output=True, check=False)


def test_every_command_works(tmp_path: Path) -> None:
    place = tmp_path / "ö 日本"
    scene, run = str(place / "scene"), str(place / "run")
    write_scene(Path(scene), size=32, train=4, val=1, test=2)
    few = "--preset=dnerf", "--steps=2", "--threads=1", "--set=splats.count=100"
    calls = [
        ["train", "--help"],
        ["presets", "dnerf"],
        ["train", "--data", scene, "--out", run, *few],
        ["eval", run, "--report"],
        ["render", run, "--path=test", "--video=none"],
        ["export", run, "--format=ply", "--time=0", "--out", str(place / "a.ply")],
        ["prepare", scene, "--out", str(place / "prepared")],
        ["info", run],
    ]
    done = in_ascii(["-c", CALLS, json.dumps(calls)])
    assert done.returncode == 0 and b"Traceback" not in done.stderr, done.stderr
    assert done.stdout.isascii() and done.stderr.isascii()
    assert b"\\xf6 \\u65e5\\u672c" in done.stdout
    assert scene in json.loads((Path(run) / "run.json").read_text("utf-8"))["data"]["path"]


def test_where_names_of_files_are_to_be_ascii_it_is_said_what_to_do(tmp_path: Path) -> None:
    done = in_ascii(["-m", "gsdmsr_cli", "info", str(tmp_path / "ö")], PYTHONUTF8="0")
    assert done.returncode == 2 and done.stderr.count(b"\n") == 1
    assert done.stderr.endswith(b"Python takes names for ascii here; set PYTHONUTF8=1\n")
