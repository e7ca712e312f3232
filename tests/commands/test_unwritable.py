"""Folders that cannot be written: what needs no writing there works, and the rest says why not."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gsdmsr_cli.demo.synthetic import write_scene

CALLS = """
import contextlib, io, json, subprocess, sys
from gsdmsr_cli.cli.main import main
from gsdmsr_cli.evaluation import speed

speed.SECONDS, told = 0.01, []
for arguments in json.loads(sys.argv[1]):
    if arguments[0] == "read-only":
        subprocess.run(["mount", "--bind", arguments[1], arguments[1]], check=True)
        subprocess.run(["mount", "-o", "remount,ro,bind", arguments[1]], check=True)
        continue
    sys.argv, err = ["gsdmsr", *arguments], io.StringIO()
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(err):
        try:
            main()
        except SystemExit as ended:
            told.append([ended.code, err.getvalue()])
print(json.dumps(told))
"""
"""Runs command lines one after the other in one process; prints exit codes and stderr."""


def results_of(calls: list[str]) -> list[tuple[int, str]]:
    """Return the exit codes of commands, and what they say.

    There is neither a home nor a place for a cache, and between them folders become read-only,
    for root too, whom no rights keep out.
    """
    bare = os.environ | {"HOME": "/dev/null/nowhere", "XDG_CACHE_HOME": "/dev/null/nowhere"}
    command = [sys.executable, "-c", CALLS, json.dumps([call.split() for call in calls])]
    command = ["unshare", "-rm", *command]
    done = subprocess.run(command, env=bare, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return [(code, said) for code, said in json.loads(done.stdout)]


@pytest.mark.skipif(
    sys.platform != "linux" or os.system("unshare -rm true 2>/dev/null") != 0,
    reason="this user may not mount",
)
def test_data_and_a_run_that_cannot_be_written(tmp_path: Path) -> None:
    scene, made, out = tmp_path / "scene", tmp_path / "made", tmp_path / "out"
    write_scene(scene, size=32, train=4, val=1, test=2)
    few = "--preset dnerf --steps 2 --threads 1 --set splats.count=100"
    works = [
        f"train --data {scene} --out {made} {few}",
        f"info {made}",
        f"eval {made} --report --out {out}/eval",
        f"render {made} --path test --video none --out {out}/film",
        f"export {made} --format ply --time 0 --out {out}/half.ply",
        f"prepare {scene} --out {out}/prepared",
    ]
    refused = [
        f"eval {made}",
        f"render {made} --path test --video none",
        f"train --data {scene} --out {made} --resume --steps 4",
        f"train --data {scene} --out {made} --overwrite {few}",
    ]
    first, *others = works
    calls = [f"read-only {scene}", first, f"read-only {made}", *others, *refused]
    told = list(zip([*works, *refused], results_of(calls), strict=True))
    for call, (code, said) in told[: len(works)]:
        assert code == 0 and "warning" not in said, (call, said)
    for call, (code, said) in told[len(works) :]:
        *_, line = said.splitlines()
        assert code == 3 and said.count("error: ") == 1, (call, said)
        assert line.startswith(f"error: {made}"), (call, said)
        assert line.endswith("; choose another --out or change the rights"), (call, said)
