"""Cores and memory as a container has them, from the files that Linux tells them in."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import gsdmsr_cli
from gsdmsr_cli.ground.limits import available_memory, cores

OWN = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="files of Linux")


def machine(root: Path, groups: str, **files: str) -> Path:
    """Write the files of a machine; "__" in a name is a folder's border, "DOT" a dot."""
    for name, text in {"proc__self__cgroup": groups, **files}.items():
        path = root / name.replace("__", "/").replace("DOT", ".")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


@pytest.mark.parametrize(
    ("quota", "expected"),
    [("max 100000\n", OWN), ("100000 100000", 1), ("50000 100000", 1), ("150000 100000", 2),
     ("1000000000 1000", OWN), ("", OWN), ("x y", OWN), ("0 0", OWN)],
)  # fmt: skip
def test_the_quota_of_version_2_limits_the_cores(tmp_path: Path, quota: str, expected: int) -> None:
    root = machine(tmp_path, "0::/\n", sys__fs__cgroup__cpuDOTmax=quota)
    assert cores(root) == min(expected, OWN)


def test_the_quota_of_a_group_above_counts(tmp_path: Path) -> None:
    files = {"sys__fs__cgroup__a__cpuDOTmax": "100000 100000",
             "sys__fs__cgroup__a__b__cpuDOTmax": "max 100000"}  # fmt: skip
    assert cores(machine(tmp_path, "0::/a/b\n", **files)) == 1


def test_the_quota_of_version_1_limits_the_cores(tmp_path: Path) -> None:
    files = {"sys__fs__cgroup__cpu,cpuacct__x__cpuDOTcfs_quota_us": "100000\n",
             "sys__fs__cgroup__cpu,cpuacct__x__cpuDOTcfs_period_us": "100000\n"}  # fmt: skip
    assert cores(machine(tmp_path, "3:cpu,cpuacct:/x\n", **files)) == 1
    (tmp_path / "sys/fs/cgroup/cpu,cpuacct/x/cpu.cfs_quota_us").write_text("-1\n")
    assert cores(tmp_path) == OWN


def test_a_group_whose_folder_is_not_to_be_seen_is_the_top_one(tmp_path: Path) -> None:
    """As in a container whose groups have no namespace of their own."""
    root = machine(tmp_path, "0::/docker/0123\n", sys__fs__cgroup__cpuDOTmax="100000 100000")
    assert cores(root) == 1


def test_affinity_limits_the_cores() -> None:
    program = "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))}); "
    program += "from gsdmsr_cli.ground.limits import cores; print(cores())"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.stdout == "1\n", done.stderr


MEMINFO = "MemTotal:       4000 kB\nMemFree:  1 kB\nMemAvailable:    3000 kB\n"


def test_memory_is_what_the_group_has_left(tmp_path: Path) -> None:
    files = {"sys__fs__cgroup__memoryDOTmax": "1000000\n", "proc__meminfo": MEMINFO,
             "sys__fs__cgroup__memoryDOTcurrent": "700000\n",
             "sys__fs__cgroup__memoryDOTstat": "anon 5\ninactive_file 50000\n"}  # fmt: skip
    assert available_memory(machine(tmp_path, "0::/\n", **files)) == 350_000


def test_memory_of_version_1(tmp_path: Path) -> None:
    files = {"sys__fs__cgroup__memory__memoryDOTlimit_in_bytes": "1000000\n",
             "sys__fs__cgroup__memory__memoryDOTusage_in_bytes": "700000\n",
             "sys__fs__cgroup__memory__memoryDOTstat": "total_inactive_file 1\n",
             "proc__meminfo": MEMINFO}  # fmt: skip
    assert available_memory(machine(tmp_path, "4:memory:/\n", **files)) == 300_001
    (tmp_path / "sys/fs/cgroup/memory/memory.limit_in_bytes").write_text("9223372036854771712")
    assert available_memory(tmp_path) == 3000 << 10


def test_memory_of_the_machine_where_no_group_has_a_limit(tmp_path: Path) -> None:
    files = {"sys__fs__cgroup__memoryDOTmax": "max\n", "proc__meminfo": MEMINFO}
    assert available_memory(machine(tmp_path, "0::/\n", **files)) == 3000 << 10


def test_where_nobody_says_nothing_is_known(tmp_path: Path) -> None:
    assert available_memory(tmp_path) is None and cores(tmp_path) == OWN


def test_this_machine_has_some() -> None:
    room = available_memory()
    assert room is not None and room > 1 << 20 and 1 <= cores() <= OWN


def test_kernels_use_no_more_threads_than_the_quota_allows(tmp_path: Path) -> None:
    root = machine(tmp_path, "0::/\n", sys__fs__cgroup__cpuDOTmax="100000 100000")
    program = (
        "from pathlib import Path; from gsdmsr_cli.ground import limits; "
        f"limits.cores.__defaults__ = (Path({str(root)!r}),); "
        "from gsdmsr_cli.backends.cpu import jit; print(jit.set_threads(0), jit.threads())"
    )
    environment = {name: value for name, value in os.environ.items() if name[:5] != "NUMBA"}
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    assert done.stdout == "1 1\n", done.stderr


def test_nobody_counts_the_cores_of_the_whole_machine() -> None:
    package = Path(gsdmsr_cli.__file__).parent
    asking = [
        path.name
        for path in package.rglob("*.py")
        if re.search(r"cpu_count\(|ThreadPoolExecutor\(\)", path.read_text(encoding="utf-8"))
    ]
    assert asking == ["limits.py"]
