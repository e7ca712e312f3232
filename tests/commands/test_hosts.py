"""Trainings on several hosts, which are simulated: one training by all, and trials on Ray."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
import simulated_hosts
from simulated_hosts import INTERFACE, Host
from training_checks import OPTIONS, STEPS

from gsdmsr_cli.benchmark.kills import same
from gsdmsr_cli.runs.run import Run, open_run

REASON = simulated_hosts.missing()
pytestmark = pytest.mark.skipif(REASON is not None, reason=str(REASON))

LINE = [
    "--preset=dnerf", *(f"--set={text}" for text in OPTIONS), "--set=training.views_per_step=4",
    "--threads=1", "--device=cpu", "--set=training.checkpoint_minutes=0.005",
]  # fmt: skip
MEETING = "last_call_timeout=3,keep_alive_interval=1,keep_alive_max_attempt=3"
"""A host that has not been heard of for three seconds is lost."""

TIMEOUT_S = 300


@pytest.fixture
def hosts() -> Iterator[list[Host]]:
    with simulated_hosts.hosts(4) as made:
        yield made


@pytest.fixture
def begun() -> Iterator[ExitStack]:
    """Processes that have been begun; they are killed at the end."""
    with ExitStack() as stack:
        yield stack


def begin(
    host: Host, command: list[str], log: Path, begun: ExitStack, **of: str
) -> subprocess.Popen[bytes]:
    """Begin a command on a host; environment variables are given by name."""
    own = {"own": Path(of.pop("own"))} if "own" in of else {}
    shown = begun.enter_context(log.open("wb"))
    process = subprocess.Popen(
        host.line(command, **own), env={**os.environ, **of}, stdout=shown, stderr=shown
    )
    begun.callback(process.kill)
    return process


def train_on(
    hosts: list[Host], how_many: str, line: list[str], folder: Path, begun: ExitStack
) -> list[subprocess.Popen[bytes]]:
    """Begin one training by a rank on each host; the first is where they meet."""
    meeting = ["--rdzv-backend=c10d", "--rdzv-id=hosts", f"--rdzv-conf={MEETING}"]
    meeting += [f"--rdzv-endpoint={hosts[0].address}:29400", "--max-restarts=3"]
    ranks = [f"--nnodes={how_many}", "--nproc-per-node=1"]
    return [
        begin(
            host,
            [sys.executable, "-m", "torch.distributed.run", *meeting, *ranks,
             f"--local-addr={host.address}", "-m", "gsdmsr_cli", *line],
            folder / f"{host.name}.log", begun, GLOO_SOCKET_IFNAME=INTERFACE,
        )
        for host in hosts
    ]  # fmt: skip


def wait_until(reached: Callable[[], bool], log: Path) -> None:
    end = time.monotonic() + TIMEOUT_S
    while not reached():
        assert time.monotonic() < end, log.read_text()
        time.sleep(0.05)


def trained_alone(data: Path, run: Path, *more: str) -> Run:
    line = ["train", "--data", str(data), "--out", str(run), *LINE, *more]
    subprocess.run(
        [sys.executable, "-m", "gsdmsr_cli", *line], stderr=subprocess.DEVNULL, timeout=TIMEOUT_S,
        check=True,
    )  # fmt: skip
    return open_run(run)


def test_four_hosts_give_the_result_of_one_process(
    hosts: list[Host], tiny_scene: Path, tmp_path: Path, begun: ExitStack
) -> None:
    alone, run = trained_alone(tiny_scene, tmp_path / "alone"), tmp_path / "run"
    line = ["train", "--data", str(tiny_scene), "--out", str(run), *LINE]
    for process in train_on(hosts, "4", line, tmp_path, begun):
        assert process.wait(timeout=TIMEOUT_S) == 0, (tmp_path / "host1.log").read_text()
    assert same(open_run(run).load(), alone.load())
    account = open_run(run).account(STEPS)["ranks"]
    assert account["size"] == 4 and account["received_mb_per_step"] > 0


def test_hosts_go_on_without_one_that_loses_its_power(
    hosts: list[Host], tiny_scene: Path, tmp_path: Path, begun: ExitStack
) -> None:
    alone, run = trained_alone(tiny_scene, tmp_path / "alone", "--steps=300"), tmp_path / "run"
    line = ["train", "--data", str(tiny_scene), "--out", str(run), *LINE, "--steps=300"]
    *others, last = train_on(hosts, "3:4", line, tmp_path, begun)
    rows = run / "metrics.jsonl"
    wait_until(lambda: rows.is_file() and len(open_run(run).read_log()) > 2, tmp_path / "host1.log")
    hosts[3].kill()
    for process in others:
        assert process.wait(timeout=TIMEOUT_S) == 0, (tmp_path / "host1.log").read_text()
    assert last.wait() != 0
    found = open_run(run)
    assert (found.restarted_at or 0) > 0  # they have not begun anew
    assert found.account(300)["ranks"]["size"] == 3
    assert same(found.load(), alone.load())


def test_trials_go_to_a_cluster_of_ray_on_other_hosts(
    hosts: list[Host], tiny_scene: Path, tmp_path: Path, begun: ExitStack
) -> None:
    pytest.importorskip("ray", reason="pip install 'gsdmsr[ray]'")
    caller, head, other, _ = hosts
    (tmp_path / "token").write_text("0123456789abcdef" * 4)
    ours = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(tmp_path / "token")}
    # each host has sockets of its own there, whose paths may have some hundred letters
    sessions = Path(begun.enter_context(TemporaryDirectory(prefix="ray")))
    ray = [str(Path(sys.executable).with_name("ray")), "start", "--block", "--num-cpus=1"]
    ray += ["--object-store-memory=100000000", "--disable-usage-stats"]
    first = [f"--node-ip-address={head.address}", "--head", "--port=6379", f"--temp-dir={sessions}"]
    first += ["--ray-client-server-port=10001", "--include-dashboard=false"]
    began = tmp_path / "head.log"
    begin(head, [*ray, *first], began, begun, own=str(sessions), **ours)
    wait_until(lambda: "runtime started" in began.read_text(), began)
    joined = [f"--node-ip-address={other.address}", f"--address={head.address}:6379"]
    begin(other, [*ray, *joined], tmp_path / "other.log", begun, own=str(sessions), **ours)

    bench = tmp_path / "bench"
    line = ["benchmark", "scenes", str(tiny_scene), "--out", str(bench), "--preset=static"]
    line += ["--seed=0", "--seed=1", "--steps=40", f"--workers=ray://{head.address}:10001"]
    told = tmp_path / "caller.log"
    asked = begin(caller, [sys.executable, "-m", "gsdmsr_cli", *line], told, begun, **ours)
    assert asked.wait(timeout=TIMEOUT_S) == 0, told.read_text()
    assert "2 of 2 trials" in told.read_text()
    assert len(list(bench.glob("*/*/eval/metrics.json"))) == 2
