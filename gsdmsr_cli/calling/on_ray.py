"""The connection to a Ray cluster, and what its workers must have."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from uuid import uuid4

from gsdmsr_cli import __version__
from gsdmsr_cli.calling.calls import Line
from gsdmsr_cli.ground.errors import DataError, UsageError
from gsdmsr_cli.ground.files import write_text

Needs = dict[str, Any]
"""What a worker must have, as plain values, see ``on_worker.lack``."""

ATTEMPTS = 3
"""How often a cluster is asked that answers, but begins no connection within Ray's 30 s: its head
node loads Ray once for each caller, which takes longer where others use its disk and cores."""


@contextmanager
def connected(workers: str) -> Iterator[Any]:
    """Yield the module of Ray, connected to a cluster; let go of it at the end.

    Args:
        workers: "ray://HOST:PORT" of a cluster, "auto" for the one that this machine belongs to,
            or a number of CPUs for one of its own.

    Raises:
        UsageError: Ray is not installed, or ``workers`` is none of these.
        DataError: there is no such cluster, or it begins no connection.
    """
    how = _how(workers)
    try:
        ray = importlib.import_module("ray")
    except ImportError as error:
        raise UsageError(
            f"--workers needs ray, which cannot be imported ({error}); pip install 'gsdmsr[ray]'"
        ) from error
    try:
        _connect(ray, how)
    except ConnectionAbortedError as error:
        raise DataError(
            f"--workers {workers}: the cluster answers, but has begun no connection in {ATTEMPTS} "
            f"attempts ({str(error).splitlines()[-1][:300]}); see whether its head node has cores "
            "and memory left"
        ) from error
    except (OSError, RuntimeError, ImportError, ValueError, ray.exceptions.RayError) as error:
        raise DataError(
            f"--workers {workers}: no cluster answers ({str(error).splitlines()[0][:200]}); start "
            "one with ray start --head. Where that machine has ~/.ray/auth_token, this one needs "
            "the same file and RAY_AUTH_MODE=token"
        ) from error
    try:
        yield ray
    finally:
        ray.shutdown()


def _connect(ray: Any, how: dict[str, Any]) -> None:
    for left in reversed(range(ATTEMPTS)):
        try:
            ray.init(log_to_driver=False, logging_level="error", **how)
            return
        except ConnectionAbortedError:
            if not left:
                raise


def _how(workers: str) -> dict[str, Any]:
    if workers.isdecimal() and int(workers) > 0:
        return {"address": "local", "num_cpus": int(workers), "include_dashboard": False}
    if workers == "auto" or re.fullmatch(r"ray://[^\s:/]+:\d+", workers):
        return {"address": workers}
    raise UsageError(
        f"--workers {workers}: allowed are ray://HOST:PORT, auto, or a number of CPUs of this "
        "machine"
    )


@contextmanager
def needs_of(out: Path, inputs: Sequence[Path]) -> Iterator[Needs]:
    """Yield what workers need: these inputs, and the folder ``out``, in which a file is to be seen.

    Raises:
        DataError: the folder cannot be written.
    """
    token = out / f".gsdmsr-{uuid4().hex}.part"
    write_text(token, token.name)
    paths = [str(path) for path in inputs]
    try:
        yield {"paths": paths, "token": str(token), "out": str(out), "version": __version__}
    finally:
        token.unlink(missing_ok=True)


def require_workers(ray: Any, needs: Needs) -> None:
    """Raise DataError that names each machine of the cluster which lacks something, and what."""
    strategies = importlib.import_module("ray.util.scheduling_strategies")
    task, asked = ray.remote(task_of_ray()), []
    for node in ray.nodes():
        if node["Alive"]:
            there = strategies.NodeAffinitySchedulingStrategy(node["NodeID"], soft=False)
            options = {"num_cpus": 0, "max_retries": 0, "scheduling_strategy": there}
            asked.append(task.options(**options).remote([], "", 1, needs))
    lacks = [f"worker {host}: {lack}" for host, _, lack in ray.get(asked) if lack]
    if lacks:
        raise DataError("; ".join(lacks))


def task_of_ray() -> Callable[..., tuple[str, int, str]]:
    """Return the function that workers run, see ``on_worker.do``."""

    def work(line: Line, log: str, threads: int, needs: Needs) -> tuple[str, int, str]:
        # a function within another goes to workers by value: one without gsdmsr can say so
        import platform

        try:
            from gsdmsr_cli.calling.on_worker import do
        except ImportError as error:
            return platform.node(), 3, f"gsdmsr cannot be imported there: {error}"
        return do(line, log, threads, needs)

    return work
