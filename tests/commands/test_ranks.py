"""gsdmsr train under a real torchrun: the result of one process, and ranks that fail."""

from __future__ import annotations

import math
import os
import random
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
from training_checks import OPTIONS, STEPS

from gsdmsr_cli.benchmark.kills import OFTEN, same
from gsdmsr_cli.benchmark.ranks import ranks_of, train_in_ranks
from gsdmsr_cli.runs.run import open_run

torch_distributed = pytest.importorskip("torch.distributed")
pytestmark = pytest.mark.skipif(
    not sys.platform.startswith("linux") or not torch_distributed.is_gloo_available(),
    reason="torchrun is tested on Linux, with gloo",
)

CHANCE = random.Random(0)
LINE = [
    "--preset=dnerf", *(f"--set={text}" for text in OPTIONS), "--set=training.views_per_step=3",
    "--threads=1", "--device=cpu",
]  # fmt: skip


def options(data: Path, run: Path, *more: str) -> list[str]:
    return ["train", "--data", str(data), "--out", str(run), *LINE, *more]


def train(data: Path, run: Path, *more: str) -> None:
    line = [sys.executable, "-m", "gsdmsr_cli", *options(data, run, *more)]
    subprocess.run(line, stderr=subprocess.DEVNULL, timeout=300, check=True)


@pytest.fixture(scope="module")
def alone(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of one process."""
    run = tmp_path_factory.mktemp("ranks") / "alone"
    train(tiny_scene, run)
    return run


@pytest.mark.parametrize("ranks", [1, 2, 3])
def test_ranks_give_the_result_of_one_process(
    alone: Path, tiny_scene: Path, tmp_path: Path, ranks: int
) -> None:
    run, log = tmp_path / "run", tmp_path / "log"
    train_in_ranks(options(tiny_scene, run), ranks, log, math.inf, CHANCE)
    found = open_run(run).load()
    assert same(found, open_run(alone).load()) and found.step == STEPS
    assert len(found.tensors["splats.means"]) == 200  # they have grown on the way
    account = open_run(run).account(STEPS)["ranks"]
    assert account["size"] == ranks
    assert (account["received_mb_per_step"] > 0) == (ranks > 1)
    assert log.read_text().count("trained 40 steps") == 1  # the first one speaks for all


def test_a_rank_that_is_killed_is_recovered(tiny_scene: Path, tmp_path: Path) -> None:
    line = "--steps=300", f"--set={OFTEN}"
    alone, run, log = tmp_path / "alone", tmp_path / "run", tmp_path / "log"
    train(tiny_scene, alone, *line)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    command += ["--max-restarts=2", "-m", "gsdmsr_cli", *options(tiny_scene, run, *line)]
    with log.open("w") as shown, subprocess.Popen(command, stdout=shown, stderr=shown) as torchrun:
        end = time.monotonic() + 200
        while not (run / "metrics.jsonl").is_file() or not open_run(run).read_log():
            assert time.monotonic() < end and torchrun.poll() is None, log.read_text()
            time.sleep(0.05)
        os.kill(ranks_of(torchrun.pid)[-1], signal.SIGKILL)
        assert torchrun.wait(timeout=200) == 0, log.read_text()
    assert (open_run(run).restarted_at or 0) > 0  # it has not begun anew
    assert same(open_run(run).load(), open_run(alone).load())


def test_a_torchrun_that_is_ended_ends_all_ranks_after_one_step(
    tiny_scene: Path, tmp_path: Path
) -> None:
    """It signals every rank twice; a single process would not wait for its step any more."""
    run, log = tmp_path / "run", tmp_path / "log"
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    command += ["-m", "gsdmsr_cli", *options(tiny_scene, run, "--steps=1000000")]
    with log.open("w") as shown, subprocess.Popen(command, stdout=shown, stderr=shown) as torchrun:
        end = time.monotonic() + 200
        while not (run / "metrics.jsonl").is_file() or not open_run(run).read_log():
            assert time.monotonic() < end and torchrun.poll() is None, log.read_text()
            time.sleep(0.05)
        torchrun.send_signal(signal.SIGINT)
        torchrun.wait(timeout=100)
    opened = open_run(run)
    step = opened.load().step
    assert f"interrupted at step {step}" in log.read_text() and "lost" not in log.read_text()
    assert opened.read_log()[-1]["step"] == step and opened.account(step)


def free_port() -> int:
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return int(one.getsockname()[1])


def on_two_hosts(line: list[str], folders: list[Path]) -> list[subprocess.CompletedProcess[str]]:
    """Run a command in two ranks as on two machines, each in a working folder of its own."""
    where = ["--nnodes=2", "--nproc-per-node=1", "--master-addr=127.0.0.1"]
    where += [f"--master-port={free_port()}"]
    command = [sys.executable, "-m", "torch.distributed.run", *where]
    running = [
        subprocess.Popen(
            [*command, f"--node-rank={rank}", "-m", "gsdmsr_cli", *line],
            cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )
        for rank, folder in enumerate(folders)
    ]  # fmt: skip
    told = [process.communicate(timeout=200) for process in running]
    return [
        subprocess.CompletedProcess([], process.returncode, *texts)
        for process, texts in zip(running, told, strict=True)
    ]


@pytest.fixture
def hosts(tiny_scene: Path, tmp_path: Path) -> list[Path]:
    """Working folders of two machines, of which the first has the data."""
    folders = [tmp_path / "a", tmp_path / "b"]
    shutil.copytree(tiny_scene, folders[0] / "data")
    folders[1].mkdir()
    return folders


def errors(done: subprocess.CompletedProcess[str]) -> list[str]:
    return [line for line in done.stderr.splitlines() if line.startswith("error: ")]


def test_a_rank_without_the_data_is_named(hosts: list[Path]) -> None:
    first, second = on_two_hosts(options(Path("data"), Path("run")), hosts)
    (told,) = errors(first)
    assert told.startswith(f"error: rank 1 on {socket.gethostname()}: data folder data does not")
    assert errors(second) == [
        "error: data folder data does not exist; give the folder of a capture"
    ]
    assert first.returncode != 0 and second.returncode != 0
    assert not (hosts[0] / "run").exists()


def test_a_rank_with_other_data_is_named(tiny_scene: Path, hosts: list[Path]) -> None:
    layout = Path(shutil.copytree(tiny_scene, hosts[1] / "data")) / "transforms_val.json"
    layout.write_text(layout.read_text() + "\n")
    first, second = on_two_hosts(options(Path("data"), Path("run")), hosts)
    (told,) = errors(first)
    assert "rank 1 on" in told and "its layout files" in told and "need the same" in told
    assert errors(second) == [] and second.returncode != 0


def test_more_ranks_than_views_are_refused(tiny_scene: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    line = options(tiny_scene, tmp_path / "run", "--set=training.views_per_step=1")
    done = subprocess.run(
        [*command, "-m", "gsdmsr_cli", *line], capture_output=True, text=True, timeout=200,
        check=False,
    )  # fmt: skip
    (told,) = errors(done)
    assert "2 ranks share the views of a step, and training.views_per_step is 1" in told
    assert not (tmp_path / "run").exists()
