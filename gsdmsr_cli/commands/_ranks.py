"""A training that torchrun has started several times: all ranks begin together, or none does."""

from __future__ import annotations

import importlib
import os
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from gsdmsr_cli.commands._party import Party
from gsdmsr_cli.ground import machine, say
from gsdmsr_cli.ground.errors import DataError, GsdmsrError, UsageError
from gsdmsr_cli.scene.picture_hashes import digest
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training.trainer import Trainer

_INTERRUPTED = 130

_MARK = "TORCHELASTIC_RUN_ID"
"""What torchrun sets and nobody else: RANK and WORLD_SIZE stand in other environments as well."""

_RESTARTS = "TORCHELASTIC_RESTART_COUNT"


@dataclass(frozen=True)
class _Trouble:
    """Why a rank cannot begin."""

    rank: int
    host: str
    text: str
    exit_code: int


class _Connected(Party):
    """Ranks that a process group connects."""

    def __init__(self, restarts: int, beside: int, job: str) -> None:
        from gsdmsr_cli.training.ranks.connected import Connected
        from gsdmsr_cli.training.ranks.link import Link

        self._link = Link()
        super().__init__(Connected(self._link), restarts, beside, job)

    def level(self, trainer: Trainer) -> None:
        here = trainer.checkpoint() if self.leads and trainer.clock.step else None
        told = self.tell(here)
        if told is not None and not self.leads:
            trainer.restore(told)

    def tell(self, value: Any) -> Any:
        return self._link.told_by_first(value)

    @contextmanager
    def all_or_none(self) -> Iterator[None]:
        own, raised = "", None
        code = 0
        try:
            yield
        except (GsdmsrError, OSError, KeyboardInterrupt) as error:
            raised, own = error, str(error) or "interrupted"
            code = getattr(error, "exit_code", DataError.exit_code)
            code = _INTERRUPTED if isinstance(error, KeyboardInterrupt) else code
        told = self._link.gather_objects(_Trouble(self.ranks.rank, platform.node(), own, code))
        if raised is not None:
            raise raised
        self._end_with(next((trouble for trouble in told if trouble.exit_code), None))

    def _end_with(self, trouble: _Trouble | None) -> None:
        if trouble is None:
            return
        if trouble.exit_code == _INTERRUPTED:
            raise KeyboardInterrupt
        if not self.leads:
            raise SystemExit(trouble.exit_code)
        kind = UsageError if trouble.exit_code == UsageError.exit_code else DataError
        raise kind(f"rank {trouble.rank} on {trouble.host}: {trouble.text}")

    def require_same(self, scene: Scene) -> None:
        facts = {
            "data": f"{scene.fingerprint} (its layout files)",
            "pictures": digest(scene.pictures),
            **machine.versions(),
        }
        hosts = self._link.gather_objects((platform.node(), facts, machine.cpu_name()))
        if not self.leads:
            return
        for rank, (host, found, processor) in enumerate(hosts):
            name = _first_difference(found, facts)
            if name is not None:
                raise DataError(
                    f"rank {rank} on {host} has {name} {found[name]}, rank 0 {facts[name]}; all "
                    "ranks need the same"
                )
            if processor != hosts[0][2]:
                say.warn(
                    f"rank {rank} on {host} runs on {processor}, rank 0 on {hosts[0][2]}: where "
                    "these round otherwise, the training ends with an error"
                )


def _first_difference(found: Mapping[str, str], expected: Mapping[str, str]) -> str | None:
    return next((name for name, value in expected.items() if found.get(name) != value), None)


def _job() -> str:
    """Return what tells this call of torchrun from others."""
    name = os.environ[_MARK]
    return f"{platform.node()} {os.getppid()}" if name == "none" else name


@contextmanager
def joined() -> Iterator[Party]:
    """Join the other ranks, if torchrun has started this process.

    Raises:
        UsageError: torch has no gloo.
        DataError: the other ranks cannot be reached.
    """
    if _MARK not in os.environ or "RANK" not in os.environ:
        yield Party()
        return
    distributed: Any = importlib.import_module("torch.distributed")
    if not distributed.is_available() or not distributed.is_gloo_available():
        raise UsageError("this build of torch has no gloo, which connects ranks; install another")
    restarts, beside = (int(os.environ.get(n, "0")) for n in (_RESTARTS, "LOCAL_WORLD_SIZE"))
    try:
        store, rank, size = next(iter(distributed.rendezvous("env://")))
        # torchrun keeps its store over restarts, and with it addresses of ranks that are no more
        fresh = distributed.PrefixStore(f"gsdmsr {restarts} {size}", store)
        distributed.init_process_group("gloo", store=fresh, rank=rank, world_size=size)
    except (RuntimeError, ValueError) as error:
        raise DataError(
            f"{platform.node()} cannot reach the other ranks: {str(error).splitlines()[0][:200]}; "
            "set GLOO_SOCKET_IFNAME to the network interface that the machines share"
        ) from error
    try:
        yield _Connected(restarts, beside, _job())
    finally:
        distributed.destroy_process_group()
