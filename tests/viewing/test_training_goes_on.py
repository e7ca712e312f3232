"""Whatever happens to those who look at a training, it ends as if nobody had."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

OPTIONS = (
    "--preset", "dnerf", "--steps", "1500", "--set", "splats.count=200", "--set",
    "training.threads=1",
)  # fmt: skip


def line_of(data: Path, out: Path, *words: str) -> list[str]:
    where = "--data", str(data), "--out", str(out)
    return [sys.executable, "-m", "gsdmsr_cli", "train", *where, *OPTIONS, *words, "--json"]


@pytest.fixture(scope="module")
def alone(tiny_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, torch.Tensor]:
    """What a training ends as that nobody has looked at."""
    out = tmp_path_factory.mktemp("alone") / "run"
    subprocess.run(line_of(tiny_scene, out), check=True, capture_output=True)
    assert not (out / "view").exists()
    return load_file(out / "checkpoint.safetensors")


class Looked:
    """A training with a server, at which somebody looks."""

    def __init__(self, data: Path, out: Path, log: Path) -> None:
        self.out, self.log = out, log
        with log.open("wb") as shown:
            self.process = subprocess.Popen(
                line_of(data, out, "--view"), stdout=subprocess.PIPE, stderr=shown
            )
        self._wait_for(lambda: (out / "metrics.jsonl").is_file())  # the server has been started
        self.process.send_signal(signal.SIGSTOP)  # a busy machine starts the server slowly
        self._wait_for(lambda: "http://" in self.text())
        self.process.send_signal(signal.SIGCONT)
        self.address = re.findall(r"http://\S+", self.text())[0]
        self.port = int(self.address.rpartition(":")[2].strip("/"))

    def _wait_for(self, seen: Callable[[], bool]) -> None:
        deadline = time.monotonic() + 120
        while not seen():
            assert time.monotonic() < deadline and self.process.poll() is None, self.text()
            time.sleep(0.02)

    def text(self) -> str:
        return self.log.read_text(encoding="utf-8")

    def state(self) -> Any:
        with urllib.request.urlopen(self.address + "state.json", timeout=30) as answer:
            return json.load(answer)

    def server(self) -> int:
        """Return the process of the server: the only child that is one."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children")
        for child in map(int, children.read_text().split()):
            if b"view" in Path(f"/proc/{child}/cmdline").read_bytes().split(b"\0"):
                return child
        raise AssertionError("there is no server")

    def end(self) -> None:
        assert self.process.wait(300) == 0, self.text()


@pytest.fixture
def looked(tiny_scene: Path, tmp_path: Path) -> Iterator[Looked]:
    looked = Looked(tiny_scene, tmp_path / "run", tmp_path / "shown")
    try:
        yield looked
    finally:
        looked.process.kill()
        assert looked.process.stdout is not None
        looked.process.stdout.close()


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs /proc")
def test_a_training_ends_as_if_nobody_had_looked(
    alone: dict[str, torch.Tensor], looked: Looked
) -> None:
    assert looked.state()["progress"] <= 1
    place = "127.0.0.1", looked.port
    with ExitStack() as held:
        stalls = held.enter_context(socket.create_connection(place, timeout=10))
        stalls.sendall(b"GET /scene.dsplat HTTP/1.1\r\nHost: localhost\r\n\r\n")  # never read
        for i in range(50):
            with socket.create_connection(place, timeout=10) as client:
                client.sendall(bytes([i] * 1000) + b"\r\n\r\n")
        for _ in range(100):
            held.enter_context(socket.create_connection(place, timeout=10))
        assert looked.process.poll() is None, "too few steps to see anything"
        os.kill(looked.server(), signal.SIGKILL)
        looked.end()
    found = load_file(looked.out / "checkpoint.safetensors")
    assert found.keys() == alone.keys()
    assert all(torch.equal(found[name], tensor) for name, tensor in alone.items())
    assert not (looked.out / "view").exists() and "Traceback" not in looked.text()


def test_a_server_ends_with_the_training_that_was_killed(looked: Looked) -> None:
    server = looked.server()
    looked.process.kill()
    deadline = time.monotonic() + 20
    while Path(f"/proc/{server}").exists() and time.monotonic() < deadline:
        if Path(f"/proc/{server}/stat").read_text().split()[2] == "Z":
            break
        time.sleep(0.1)
    else:
        assert not Path(f"/proc/{server}").exists()
