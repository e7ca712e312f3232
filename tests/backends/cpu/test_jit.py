"""How kernels are compiled: where they are kept."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

from gsdmsr_cli.backends.cpu.jit import Entries

FOLDER = "import numba; from gsdmsr_cli.backends.cpu import jit; print(numba.config.CACHE_DIR)"


@pytest.mark.parametrize("first", ["", "import gsdmsr_cli.ops.rasterize.cpu.blending; "])
def test_kernels_are_kept_by_the_hash_of_all_sources_whoever_imports_numba_first(
    first: str,
) -> None:
    free = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"}
    command = [sys.executable, "-c", first + FOLDER]
    folder = subprocess.run(command, env=free, check=True, capture_output=True, text=True).stdout
    assert len(Path(folder.strip()).name) == 16


def test_a_folder_that_the_user_names_is_used(tmp_path: Path) -> None:
    named = dict(os.environ, NUMBA_CACHE_DIR=str(tmp_path))
    command = [sys.executable, "-c", FOLDER]
    folder = subprocess.run(command, env=named, check=True, capture_output=True, text=True).stdout
    assert folder.strip() == str(tmp_path)


IN_A_NEW_PROCESS = """
import json, sys
import numpy as np
from gsdmsr_cli.ops.rasterize.cpu import binning

order = binning.depth_order(np.ones(2, np.float32), np.ones(2, np.int32))
assert order.tolist() == [0, 1]
stats = binning.depth_order.stats, binning._sorted_rows.stats
print(json.dumps([[sum(s.cache_hits.values()), sum(s.cache_misses.values())] for s in stats]))
"""


def compiled_in(cache: Path, code: str = IN_A_NEW_PROCESS) -> Any:
    """Return what a new process prints: how often it has found two kernels in the cache or not."""
    named = dict(os.environ, NUMBA_CACHE_DIR=str(cache))
    done = subprocess.run(
        [sys.executable, "-c", code], env=named, check=True, capture_output=True, text=True
    )
    return json.loads(done.stdout)


def test_a_process_compiles_nothing_itself(tmp_path: Path) -> None:
    """Neither what it calls nor what that calls, whether or not there is a cache already."""
    assert [compiled_in(tmp_path) for _ in "12"] == [[[1, 0], [0, 0]]] * 2
    assert len(list(tmp_path.rglob("*.depth_order-*.nbc"))) == 1
    assert len(list(tmp_path.rglob("*._sorted_rows-*.nbc"))) == 1


SERIAL_FIRST = """
import json
import numpy as np
from gsdmsr_cli.ops.photometric import cpu

drawn, target = np.ones((3, 16, 16), np.float32), np.zeros((3, 16, 16), np.uint8)
print(json.dumps(cpu.compare(drawn, target, 16, 16, 0.0, (1e30, 0.0, 1.0), np.empty_like(drawn))))
"""


def test_a_serial_kernel_may_be_the_first_that_calls_a_parallel_one(tmp_path: Path) -> None:
    """Whose threads nobody has started yet."""
    assert compiled_in(tmp_path, SERIAL_FIRST) == 1.0


def test_of_two_processes_with_an_empty_cache_one_waits_for_the_other(tmp_path: Path) -> None:
    with ThreadPoolExecutor(2) as pool:
        found = list(pool.map(compiled_in, [tmp_path, tmp_path]))
    assert found == [[[1, 0], [0, 0]]] * 2  # what one has had compiled, both have read
    assert len(list(tmp_path.rglob("*.depth_order-*.nbc"))) == 1


def test_a_process_compiles_what_no_other_can(tmp_path: Path) -> None:
    unable = "import sys; sys.executable = ''" + IN_A_NEW_PROCESS
    assert compiled_in(tmp_path, unable) == [[0, 1], [0, 1]]
    assert compiled_in(tmp_path) == [[1, 0], [0, 0]]


def test_a_folder_that_cannot_be_written_costs_time_and_a_warning(tmp_path: Path) -> None:
    """The process compiles into a temporary folder, which ends with it."""
    named = dict(os.environ, NUMBA_CACHE_DIR="/dev/null/nowhere", TMPDIR=str(tmp_path))
    command = [sys.executable, "-c", IN_A_NEW_PROCESS]
    done = subprocess.run(command, env=named, check=True, capture_output=True, text=True)
    assert json.loads(done.stdout) == [[1, 0], [0, 0]]
    assert done.stderr.count("\n") == 1 and not list(tmp_path.iterdir())
    assert done.stderr.startswith("warning: compiled kernels cannot be kept in /dev/null/nowhere")


@pytest.mark.skipif(sys.platform == "win32", reason="files cannot be bounded there")
def test_a_full_disk_costs_time_alone(tmp_path: Path) -> None:
    full = """
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
"""
    assert compiled_in(tmp_path, full + IN_A_NEW_PROCESS) == [[0, 1], [0, 1]]
    assert not list(tmp_path.rglob("*.nb?"))


ON_ONE_CORE = """
import os
import re
os.sched_setaffinity(0, [min(os.sched_getaffinity(0))])
import torch
from gsdmsr_cli.ops.nearest import nearest_points

nearest_points(torch.zeros(9, 3), torch.zeros(5, 3), torch.zeros(9, 2, dtype=torch.int32))
"""


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="processes cannot be bound here")
@pytest.mark.parametrize("last", ["", "os._exit(0) if os.fork() == 0 else os.wait()"])
def test_a_process_on_one_core_ends(last: str) -> None:
    """TBB has no threads there, and what it waits for at the end may never be done."""
    code = ON_ONE_CORE + last
    for _ in "12":
        done = subprocess.run([sys.executable, "-c", code], check=False, timeout=120)
        assert done.returncode == 0


def test_two_that_add_to_a_cache_at_once_never_get_each_others_code(tmp_path: Path) -> None:
    """As one left of a killed training does beside another: it comes between index and file."""
    one, two = (Entries(str(tmp_path), "kernel", (1.0, 2)) for _ in range(2))
    before, write = two._load_index(), one._save_data

    def write_late(name: str, data: str) -> None:
        two._load_index = lambda: dict(before)  # which it has read already
        two.save(("two",), "code of two")
        write(name, data)

    one._save_data = write_late
    one.save(("one",), "code of one")
    found = Entries(str(tmp_path), "kernel", (1.0, 2))
    assert found.load(("two",)) == "code of two" and found.load(("one",)) == "code of one"
    assert Entries(str(tmp_path), "kernel", (1.0, 3)).load(("one",)) is None  # other sources


THREE_AND_FOUR_CHANNELS = """
import numpy as np
from gsdmsr_cli.ops.series.cpu import add

for channels in 3, 4:
    start, found = np.zeros((2, channels), np.float32), np.zeros((2, channels), np.float32)
    coefficients, basis = np.ones((2, 1, channels), np.float32), np.ones((2, 1), np.float32)
    add(start, coefficients, basis, np.float32(1), 0, (0,) * channels, found)
    assert (found == 1).all(), found
print("[]")
"""


def test_no_two_forms_of_a_kernel_have_a_name_in_common(tmp_path: Path) -> None:
    compiled_in(tmp_path, THREE_AND_FOUR_CHANNELS)
    forms = [file.read_bytes() for file in tmp_path.rglob("cpu.add-*.nbc")]
    loops = [set(re.findall(rb"numba_parfor_gufunc_0x[0-9a-f]+(B\d+v\d+)", form)) for form in forms]
    assert len(loops) == 2 and all(loops) and not loops[0] & loops[1]
