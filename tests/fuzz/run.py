"""The long run of the fuzzing: ``python tests/fuzz/run.py --minutes 30`` or ``--inputs 1000000``.

Damaged inputs of all entry points (see ``targets.py``) are read in a child process, which has
512 MiB more memory than it begins with. What breaks a rule of ``guard.py``, ends the child or never
ends is a violation: it is told, and the input is saved. An input is known by its target, its number
and the seed of the run, so it can be made again.
"""

from __future__ import annotations

import argparse
import faulthandler
import json
import mmap
import os
import resource
import shutil
import struct
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from random import Random
from typing import Any

SLICE = 100
"""Inputs of a target of weight 1 in one round; rounds go on until the run is over."""

MEMORY = 512 << 20
"""Address space that inputs may take beyond what reading valid files has taken [bytes]."""

PATIENCE = 60.0
"""A child that has not finished an input for so long hangs [s]."""

SAVED = 3
"""Inputs saved for the same violation of the same target."""

_PLACE = struct.Struct("<qqq")


@dataclass
class Tally:
    """What one target has done: its inputs, their processor time and the longest one [s]."""

    inputs: int = 0
    seconds: float = 0.0
    longest: float = 0.0


@dataclass
class State:
    """What a run knows; kept in a file, since children may die.

    Attributes:
        tallies: by the names of targets.
        violations: what, where, and by which input, one for each that differs.
        counts: how often each violation was seen.
        memory: resident memory after each round [MiB].
        seconds: wall time so far.
    """

    tallies: dict[str, Tally] = field(default_factory=dict)
    violations: list[dict[str, Any]] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    memory: list[float] = field(default_factory=list)
    seconds: float = 0.0

    @property
    def inputs(self) -> int:
        return sum(tally.inputs for tally in self.tallies.values())

    def note(self, target: str, number: int, kind: str, message: str, save: Path) -> bool:
        """Count a violation; return whether its input is to be saved."""
        key = f"{target}: {kind}"
        self.counts[key] = self.counts.get(key, 0) + 1
        if self.counts[key] > SAVED:
            return False
        name = f"{''.join(c if c.isalnum() else '-' for c in target)}-{number}"
        said = {"target": target, "number": number, "kind": kind, "message": message[:500]}
        self.violations.append(said | {"file": str(save / name)})
        return True

    def write(self, path: Path) -> None:
        beside = path.with_suffix(".new")
        beside.write_text(json.dumps(asdict(self)))
        beside.replace(path)

    @staticmethod
    def read(path: Path) -> State:
        if not path.exists():
            return State()
        found = json.loads(path.read_text())
        found["tallies"] = {name: Tally(**own) for name, own in found["tallies"].items()}
        return State(**found)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--minutes", type=float, default=0.0, help="end after so long")
    parser.add_argument("--inputs", type=int, default=0, help="end after so many inputs")
    parser.add_argument("--target", default="", help="only targets whose names contain this")
    parser.add_argument("--seed", default="0", help="of all random choices")
    parser.add_argument("--save", type=Path, default=Path("fuzz-violations"), help="folder")
    parser.add_argument("--child", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--from", dest="start", default="0,0,0", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if not (options.minutes or options.inputs):
        parser.error("give --minutes or --inputs")
    return _child(options) if options.child else _parent(options)


def _parent(options: argparse.Namespace) -> int:
    """Keep a child at work until the run is over; return 1 if there were violations."""
    memory_disk = Path("/dev/shm")
    where = memory_disk if os.access(memory_disk, os.W_OK) else None
    room, start = Path(tempfile.mkdtemp(prefix="fuzz-", dir=where)), (0, 0, 0)
    try:
        while start is not None:
            start = _one_child(options, room, start)
        state = State.read(room / "state.json")
    finally:
        shutil.rmtree(room)
    print(_report(state))
    return 1 if state.violations else 0


def _one_child(
    options: argparse.Namespace, room: Path, start: tuple[int, int, int]
) -> tuple[int, int, int] | None:
    """Run a child to its end; return where the next one is to begin, None if all is done."""
    place = room / "place"
    place.write_bytes(_PLACE.pack(*start))
    arguments = [*sys.argv, "--child", str(room), "--from", ",".join(map(str, start))]
    environment = os.environ | {"MALLOC_ARENA_MAX": "1", "OPENCV_FFMPEG_THREADS": "1"}
    child = subprocess.Popen([sys.executable, *arguments], env=environment)
    seen, since, why = start, time.monotonic(), None
    while child.poll() is None:
        time.sleep(0.2)
        now = _PLACE.unpack(place.read_bytes())
        if now != seen:
            seen, since = now, time.monotonic()
        elif time.monotonic() - since > PATIENCE:
            child.kill()
            why = f"did not end in {PATIENCE:.0f} s"
    if child.returncode == 0:
        return None
    if child.returncode == 1:
        raise SystemExit("the fuzzing itself has failed, see above")
    seen = _PLACE.unpack(place.read_bytes())
    why = why or f"ended the process with {child.returncode}"
    _note_end(options, room, seen, why)
    return seen[0], seen[1], seen[2] + 1


def _note_end(
    options: argparse.Namespace, room: Path, seen: tuple[int, int, int], why: str
) -> None:
    """Note the input that a child was reading when it ended."""
    target = _chosen(options, room / "again")[seen[1]]
    state = State.read(room / "state.json")
    number = seen[0] * _slice(target) + seen[2]
    if state.note(target.name, number, why.partition(" in ")[0], why, options.save):
        _save(Path(state.violations[-1]["file"]), _input(options, target, number))
    state.write(room / "state.json")
    shutil.rmtree(room / "again")


def _child(options: argparse.Namespace) -> int:
    """Read inputs in rounds over all targets until the run is over."""
    terminal = os.fdopen(os.dup(2), "w")
    faulthandler.enable(terminal)
    sys.excepthook = lambda *error: traceback.print_exception(*error, file=terminal)
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # native libraries print what they meet
    warnings.simplefilter("ignore")
    room: Path = options.child
    shutil.rmtree(room / "files", ignore_errors=True)
    chosen, state = _chosen(options, room / "files"), State.read(room / "state.json")
    valid = [t.path.read_bytes() if t.path.exists() else None for t in chosen]
    for target in chosen:
        if target.path.exists():
            target.read(target.path)
    _limit_memory()
    with (room / "place").open("r+b") as file:
        place = mmap.mmap(file.fileno(), _PLACE.size)
    first, before = tuple(map(int, options.start.split(","))), time.monotonic() - state.seconds
    for round_, index in _turns(first, len(chosen)):
        target = chosen[index]
        begin = first[2] if (round_, index) == first[:2] else 0
        for offset in range(begin, _slice(target)):
            place[:] = _PLACE.pack(round_, index, offset)
            number = round_ * _slice(target) + offset
            _one(options, state, target, number, room / "files")
        if valid[index] is not None:
            target.path.write_bytes(valid[index])
        if index == len(chosen) - 1:
            state.memory.append(_resident_mib())
        state.seconds = time.monotonic() - before
        state.write(room / "state.json")
        if (options.inputs and state.inputs >= options.inputs) or (
            options.minutes and state.seconds >= 60 * options.minutes
        ):
            break
    return 0


def _turns(first: tuple[int, ...], count: int) -> Iterator[tuple[int, int]]:
    """Return the rounds and targets in their order, from one on, without an end."""
    round_, index = first[:2]
    while True:
        yield round_, index
        round_, index = (round_, index + 1) if index + 1 < count else (round_ + 1, 0)


def _one(options: argparse.Namespace, state: State, target: Any, number: int, folder: Path) -> None:
    """Read one input; note what it has done that none may."""
    from guard import hold

    content = _input(options, target, number)
    target.path.write_bytes(content)
    started = time.process_time()
    try:
        hold(lambda: target.read(target.path), folder)
    except Exception as error:  # whatever it is, it is what is looked for
        kind = f"{type(error).__name__} at {_place_of(error)}"
        if state.note(target.name, number, kind, str(error), options.save):
            _save(Path(state.violations[-1]["file"]), content)
    spent = time.process_time() - started
    tally = state.tallies.setdefault(target.name, Tally())
    tally.inputs, tally.seconds = tally.inputs + 1, tally.seconds + spent
    tally.longest = max(tally.longest, spent)


def _place_of(error: Exception) -> str:
    """Return the last line of ours that an error has gone through."""
    frames = traceback.extract_tb(error.__traceback__)
    ours = [frame for frame in frames if "gsdmsr_cli" in frame.filename] or frames
    return f"{Path(ours[-1].filename).name}:{ours[-1].lineno}"


def _chosen(options: argparse.Namespace, folder: Path) -> list[Any]:
    import targets

    folder.mkdir()
    found = [target for target in targets.targets(folder) if options.target in target.name]
    if not found:
        raise SystemExit(f"no target has '{options.target}' in its name")
    return found


def _slice(target: Any) -> int:
    return round(SLICE * target.weight)


def _input(options: argparse.Namespace, target: Any, number: int) -> bytes:
    return target.mutate(Random(f"{options.seed}/{target.name}/{number}"))


def _save(path: Path, content: bytes) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)


def _limit_memory() -> None:
    pages = int(Path("/proc/self/statm").read_text().split()[0])
    limit = pages * mmap.PAGESIZE + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))


def _resident_mib() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * mmap.PAGESIZE / (1 << 20)


def _report(state: State) -> str:
    lines = [f"{'target':36} {'inputs':>8} {'inputs/s':>9} {'longest [s]':>12} {'violations':>11}"]
    for name, tally in state.tallies.items():
        found = sum(n for key, n in state.counts.items() if key.startswith(f"{name}: "))
        rate = tally.inputs / max(tally.seconds, 1e-9)
        lines.append(f"{name:36} {tally.inputs:8} {rate:9.0f} {tally.longest:12.2f} {found:11}")
    quarter = max(len(state.memory) // 4, 1)
    first, last = state.memory[:quarter], state.memory[-quarter:]
    if first:
        lines.append(
            f"resident memory [MiB]: first quarter {max(first):.0f}, last quarter {max(last):.0f}"
        )
    lines.append(f"{state.inputs} inputs in {state.seconds:.0f} s, {sum(state.counts.values())} "
                 "violations")  # fmt: skip
    for found in state.violations:
        lines.append(f"  {found['target']} {found['number']}: {found['kind']}: {found['message']!r}"
                     f" ({found['file']})")  # fmt: skip
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
