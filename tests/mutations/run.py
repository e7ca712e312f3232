"""Makes one wrong change at a time in a copy of the repository and tells whether tests notice it.

    python tests/mutations/run.py                         all of listed.yaml
    python tests/mutations/run.py --only 3 --only 17      some of them, by their numbers
    python tests/mutations/run.py --sample 200 --seed 0   small changes that are chosen at random
    python tests/mutations/run.py --sample 200 --again    those of them that were not noticed
    python tests/mutations/run.py --sample 200 --control  the tests that noticed, without a change

Results are appended to a file of JSON lines, one for each change; a sample that was cut short goes
on where it was. Files that kernels of the CPU are compiled from are left out of a sample unless
--kernels is given: each change compiles anew what its tests need, half a minute or more. "out of
time" is what ran longer than --limit, such as a loop without an end. For Linux.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from beside import find_tests
from changes import ROOT, Change, is_kernel, listed, reasons
from copies import Copy
from small_changes import sample


def main() -> int:
    asked = _parse()
    asked.folder.mkdir(parents=True, exist_ok=True)
    if asked.sample:
        path = asked.folder / f"sample-{asked.sample}-seed-{asked.seed}.jsonl"
        changes = _drawn(path, asked)
    else:
        path = asked.folder / "listed.jsonl"
        if not (asked.only or asked.control):
            path.unlink(missing_ok=True)
        changes = dict(enumerate(listed(), start=1))
    if asked.only:
        changes = {number: changes[number] for number in asked.only}
    if asked.control:
        return _control(path, asked)
    _try_all(changes, path, asked)
    _tell(path)
    return 0


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--only", type=int, action="append", help="number of a change")
    parser.add_argument("--sample", type=int, default=0, help="how many random changes")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kernels", action="store_true", help="change kernels as well")
    parser.add_argument("--again", action="store_true", help="try what was not noticed again")
    parser.add_argument("--control", action="store_true", help="try the tests without a change")
    parser.add_argument("--workers", type=int, choices=(1, 2), default=1)
    parser.add_argument("--limit", type=float, default=900, help="most seconds for a change")
    parser.add_argument("--folder", type=Path, default=ROOT / "build" / "mutations")
    return parser.parse_args()


def _drawn(path: Path, asked: argparse.Namespace) -> dict[int, Change]:
    """Return the changes of a sample that have no result yet; the draw is kept in the file."""
    if not path.is_file():
        rows = _draw(asked)
        path.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
    changes, verdicts = _read(path)
    ended = {n for n, v in verdicts.items() if not asked.again or v["verdict"] == "noticed"}
    again = {n for n, v in verdicts.items() if asked.again and v["verdict"] != "noticed"}
    wanted = again if asked.again else changes.keys() - ended
    return {number: changes[number] for number in sorted(wanted)}


def _draw(asked: argparse.Namespace) -> list[dict[str, Any]]:
    package = ROOT / "gsdmsr_cli"
    files = [path.relative_to(ROOT).as_posix() for path in package.rglob("*.py")]
    files = [file for file in files if asked.kernels or not is_kernel(file)]
    chosen = sample(ROOT, files, asked.sample, asked.seed)
    return [{"number": n, "change": asdict(one)} for n, one in enumerate(chosen, start=1)]


def _read(path: Path) -> tuple[dict[int, Change], dict[int, dict[str, Any]]]:
    """Return the changes of a file of results by their numbers, and the last result of each."""
    changes, verdicts = {}, {}
    for line in path.read_text(encoding="utf-8").splitlines():
        row = json.loads(line)
        if "verdict" in row:
            verdicts[row["number"]] = row
        if "change" in row:
            changes[row["number"]] = Change(
                **row["change"] | {"tests": tuple(row["change"]["tests"])}
            )
    return changes, verdicts


def _try_all(changes: dict[int, Change], path: Path, asked: argparse.Namespace) -> None:
    copies: SimpleQueue[Copy] = SimpleQueue()
    for worker in range(asked.workers):
        copies.put(Copy(asked.folder / f"copy-{worker}"))

    def attempt(number: int) -> dict[str, Any]:
        copy, change = copies.get(), changes[number]
        tests = change.tests or find_tests(ROOT, change.file)
        row: dict[str, Any] = {"number": number, "file": change.file, "name": change.name}
        try:
            with copy.changed(change):
                row |= asdict(copy.test(tests, asked.limit))
        except (ValueError, OSError) as error:
            row |= {"verdict": "no such place", "by": str(error), "seconds": 0.0}
        finally:
            copies.put(copy)
        return row

    with ThreadPoolExecutor(asked.workers) as pool, path.open("a", encoding="utf-8") as file:
        for row in pool.map(attempt, changes):
            file.write(json.dumps(row) + "\n")
            file.flush()
            print(f"{row['number']:4} {row['seconds']:6.1f} s  {row['verdict']:12} {row['file']}: "
                  f"{row['name']}  {row['by']}", flush=True)  # fmt: skip


def _control(path: Path, asked: argparse.Namespace) -> int:
    """Run every test that has noticed something without a change; return 1 if one fails then."""
    rows = _read(path)[1].values()
    # of parametrized tests all cases: their names may hold what a shell or pytest takes otherwise
    tests = sorted({row["by"].partition("[")[0] for row in rows if row["verdict"] == "noticed"})
    tests = [test for test in tests if (ROOT / test.partition("::")[0]).is_file()]
    outcome = Copy(asked.folder / "copy-0").test(tests, asked.limit)
    passed = outcome.verdict == "not noticed"
    told = "all pass" if passed else f"{outcome.verdict} {outcome.by}"
    print(f"{len(tests)} tests without a change, {outcome.seconds} s: {told}")
    return int(not passed)


def _tell(path: Path) -> None:
    changes, verdicts = _read(path)
    counts = Counter(row["verdict"] for row in verdicts.values())
    seconds = sum(row["seconds"] for row in verdicts.values())
    told = ", ".join(f"{count} {verdict}" for verdict, count in sorted(counts.items()))
    print(f"{len(verdicts)} changes: {told}; {seconds / 60:.1f} minutes; {path}")
    known = reasons()
    for number, row in sorted(verdicts.items()):
        if row["verdict"] != "noticed" and number in changes:
            change = changes[number]
            reason = known.get((change.file, change.new), "")
            print(
                f"\n{number} {change.file}:{change.line} {change.name}: {row['verdict']}; {reason}"
            )
            print(_lines("-", change.old) + _lines("+", change.new), end="")


def _lines(sign: str, text: str) -> str:
    return "".join(f"  {sign}{line}\n" for line in text.splitlines())


if __name__ == "__main__":
    sys.exit(main())
