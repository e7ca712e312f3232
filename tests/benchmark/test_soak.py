"""What a command and the processes that it starts hold is counted, and by how much it grows."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gsdmsr_cli.benchmark.soak import Sample, growth, largest, take_sample, tenths, watch
from gsdmsr_cli.ground.errors import GsdmsrError

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="memory is counted on Linux only")

HOLDS = """
import os, sys
from mmap import mmap
held = b"x" * (int(sys.argv[1]) << 20)
common = mmap(-1, 8 << 20)
common.write(b"y" * (8 << 20))
files = [open(os.devnull) for _ in range(7)]
if len(sys.argv) > 2:
    os.fork()
print(flush=True)
sys.stdin.read()
"""


def held(*arguments: str) -> Sample:
    """Return what a process holds that was asked to hold so many MiB, and perhaps to fork."""
    line = [sys.executable, "-c", HOLDS, *arguments]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(line, **pipes) as process:
        for _ in arguments:
            process.stdout.readline()
        sample = take_sample(process.pid, 1.0)
        process.stdin.close()
    return sample


def test_memory_files_and_processes_are_counted() -> None:
    little, much = held("1"), held("65")
    assert much.memory_mib - little.memory_mib == pytest.approx(64, abs=2)
    assert much.shared_mib == pytest.approx(8, abs=0.5)
    assert (much.files, much.processes) == (3 + 7, 1)


def test_what_two_processes_share_counts_once() -> None:
    alone, both = held("64"), held("64", "fork")
    assert both.processes == 2
    assert both.files == 2 * alone.files
    assert both.memory_mib - alone.memory_mib < 16
    assert both.shared_mib == pytest.approx(8, abs=0.5)


def test_a_process_that_has_ended_holds_nothing() -> None:
    done = subprocess.Popen([sys.executable, "-c", ""])
    done.wait()
    assert take_sample(done.pid, 0.0).memory_mib == 0


def test_growth_is_that_of_the_second_half_but_for_its_end() -> None:
    early = [Sample(float(s), 1000.0 + 50 * s, 5.0, 10 + s, 1) for s in range(100)]
    late = [Sample(float(s), 6000.0 + 0.5 * s, 5.0, 110, 3) for s in range(100, 199)]
    late += [Sample(199.0, 3.0, 0.0, 2, 1)]
    found = growth(early + late)
    assert found.elapsed_s == pytest.approx(3600)
    assert found.memory_mib == pytest.approx(1800, rel=0.03)
    assert (found.shared_mib, found.files, found.processes) == (0, 0, 0)
    assert largest(early + late) == Sample(199.0, 6099.0, 5.0, 110, 3)
    rows = tenths(early + late)
    assert len(rows) == 10
    assert rows[0] == Sample(9.5, 1475.0, 5.0, 19.5, 1)
    with pytest.raises(GsdmsrError, match="before four samples"):
        growth(late[:3])


def test_a_command_is_watched_to_its_end(tmp_path: Path) -> None:
    line = ["benchmark", "soak", "--every", "0.1", "--json", "--", "doctor"]
    command = [sys.executable, "-m", "gsdmsr_cli", *line]
    environment = os.environ | {"XDG_CACHE_HOME": str(tmp_path)}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert document["command"] == ["doctor"]
    assert document["largest"]["memory_mib"] > 20
    times = [sample["elapsed_s"] for sample in document["samples"]]
    assert times == sorted(times)
    assert "python" in done.stderr.lower()


def test_a_command_that_fails_is_told() -> None:
    with pytest.raises(GsdmsrError, match="gsdmsr train has failed with exit code 2"):
        watch(["train"], 0.1)
