"""What of the machine this process may use: cores and memory, as containers and schedulers limit.

Linux tells it in files: ``cpu.max`` and ``memory.max`` of control groups (version 2), their
namesakes of version 1, and ``/proc/meminfo``. Limits of the groups above count as well.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path

ROOT = Path("/")

_NO_LIMIT = 1 << 60
"""What version 1 says of groups without a limit is near 2^63."""


def cores(root: Path = ROOT) -> int:
    """Return how many cores this process may use, by its affinity and the quota of its group."""
    affinity = getattr(os, "sched_getaffinity", None)
    count = len(affinity(0)) if affinity else os.cpu_count() or 1
    shares = [_share(folder) for folder in _groups("cpu", root)]
    return max(1, min([count, *(math.ceil(share) for share in shares if share is not None)]))


def available_memory(root: Path = ROOT) -> int | None:
    """Return how much more memory this process may take [bytes], or None where nobody says.

    What the system only keeps in memory because there is room, such as files that have been read,
    counts as available.
    """
    free = [_free(folder) for folder in _groups("memory", root)]
    known = [room for room in [*free, _machine_free(root)] if room is not None]
    return max(0, min(known)) if known else None


def _groups(controller: str, root: Path) -> Iterator[Path]:
    """Yield the folders of this process's control groups and of those above them."""
    for line in _text(root / "proc/self/cgroup").splitlines():
        _, controllers, path = [*line.split(":", 2), "", ""][:3]
        if controllers and controller not in controllers.split(","):
            continue
        for name in (controllers, controller) if controllers else ("", "unified"):
            top = root / "sys/fs/cgroup" / name
            if top.is_dir():
                inner = top / path.lstrip("/")
                yield from (folder for folder in (inner, *inner.parents) if _within(folder, top))
                break


def _within(folder: Path, top: Path) -> bool:
    return folder.is_relative_to(top) and folder.is_dir()


def _share(folder: Path) -> float | None:
    """Return how many cores a group may keep busy, None for any number."""
    quota, _, period = _text(folder / "cpu.max").partition(" ")
    if not quota:
        quota, period = _text(folder / "cpu.cfs_quota_us"), _text(folder / "cpu.cfs_period_us")
    allowed, of = _number(quota), _number(period)
    return allowed / of if allowed and of and allowed > 0 else None


def _free(folder: Path) -> int | None:
    """Return what is left of a group's memory, None without a limit."""
    limit = _number(_text(folder / "memory.max"))
    used, reclaimable = _number(_text(folder / "memory.current")), "inactive_file "
    if limit is None:
        limit = _number(_text(folder / "memory.limit_in_bytes"))
        used, reclaimable = _number(_text(folder / "memory.usage_in_bytes")), "total_inactive_file "
    if limit is None or used is None or limit >= _NO_LIMIT:
        return None
    return limit - used + (_entry(_text(folder / "memory.stat"), reclaimable) or 0)


def _machine_free(root: Path) -> int | None:
    kib = _entry(_text(root / "proc/meminfo"), "MemAvailable:")
    return None if kib is None else kib << 10


def _entry(table: str, name: str) -> int | None:
    """Return the number behind a name at the beginning of a line."""
    lines = (line for line in table.splitlines() if line.startswith(name))
    words = next(lines, name).removeprefix(name).split()
    return _number(words[0]) if words else None


def _number(text: str) -> int | None:
    text = text.strip()
    return int(text) if text.lstrip("-").isdecimal() and len(text) < 30 else None


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="ascii", errors="replace")
    except OSError:
        return ""
