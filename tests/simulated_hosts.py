"""Hosts that are simulated on one machine: network namespaces that a bridge connects.

Each has an address, a loopback and a name of its own, so that what runs in one reaches the others
over its interface alone, as between machines. They share processors and storage.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import tempfile
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

INTERFACE = "eth0"


@dataclass(frozen=True)
class Host:
    """One of them.

    Attributes:
        name: its host name.
        address: its IPv4 address, which all can reach.
        namespace: that of its network, for ``ip netns``.
        names: file that says which address each name has.
    """

    name: str
    address: str
    namespace: str
    names: Path

    def line(self, command: list[str], own: Path | None = None) -> list[str]:
        """Return the command line that runs a command there.

        ``own`` is a folder that is to be the command's own, and is empty at first.
        """
        steps = [f"hostname {self.name}", f"mount --bind {self.names} /etc/hosts"]
        if own is not None:
            steps.append(f"mount -t tmpfs none {own}")
        begun = " && ".join([*steps, 'exec "$@"'])
        apart = ["unshare", "--uts", "--mount", "sh", "-c", begun, "sh", *command]
        return ["ip", "netns", "exec", self.namespace, *apart]

    def kill(self) -> None:
        """Kill all that runs there, as a loss of power does."""
        for text in _ip("netns", "pids", self.namespace).split():
            with contextlib.suppress(ProcessLookupError):
                os.kill(int(text), signal.SIGKILL)


def missing() -> str | None:
    """Return why there can be no simulated hosts, or None."""
    for tool in ("ip", "unshare", "hostname", "mount"):
        if shutil.which(tool) is None:
            return f"hosts are simulated with the program {tool}"
    try:
        with hosts(1):
            return None
    except subprocess.CalledProcessError as error:
        return f"no network namespaces: {error.stderr.strip()}"


@contextlib.contextmanager
def hosts(count: int) -> Iterator[list[Host]]:
    """Make hosts, and end what runs there and remove them afterwards.

    Raises subprocess.CalledProcessError where this process may not.
    """
    tag = uuid.uuid4().hex[:6]  # names of interfaces have 15 letters at most
    bridge = f"b{tag}"
    with contextlib.ExitStack() as undo:
        names = Path(undo.enter_context(tempfile.TemporaryDirectory())) / "hosts"
        made = [Host(f"host{i}", f"10.213.7.{i}", f"h{tag}{i}", names) for i in range(1, count + 1)]
        lines = ["127.0.0.1 localhost", *(f"{host.address} {host.name}" for host in made)]
        names.write_text("\n".join(lines) + "\n")
        _ip("link", "add", bridge, "type", "bridge")
        undo.callback(_ip, "link", "del", bridge)
        _ip("link", "set", bridge, "up")
        for i, host in enumerate(made):
            _ip("netns", "add", host.namespace)
            undo.callback(_ip, "netns", "del", host.namespace)
            undo.callback(host.kill)
            cable = ["name", INTERFACE, "netns", host.namespace]
            _ip("link", "add", f"v{tag}{i}", "type", "veth", "peer", *cable)
            _ip("link", "set", f"v{tag}{i}", "master", bridge, "up")
            _ip("-n", host.namespace, "addr", "add", f"{host.address}/24", "dev", INTERFACE)
            for one in (INTERFACE, "lo"):
                _ip("-n", host.namespace, "link", "set", one, "up")
        yield made


def _ip(*line: str) -> str:
    return subprocess.run(["ip", *line], capture_output=True, text=True, check=True).stdout
