"""What a wrong change to the package is, and where the list of known ones is kept."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import yaml

ROOT = Path(__file__).parents[2]

LIST = Path(__file__).parent / "listed.yaml"

SURVIVORS = Path(__file__).parent / "survivors.yaml"

KERNELS = (
    "ops/*/cpu.py", "ops/*/cpu/*.py", "backends/cpu/*.py", "ground/splatting_constants.py",
    "ground/ssim.py",
)  # fmt: skip
"""What kernels of the CPU are compiled from, all of them anew after each change."""


def is_kernel(file: str) -> bool:
    """Return whether kernels are compiled from a file of the package."""
    return any(Path(file).match(pattern) for pattern in KERNELS)


@dataclass(frozen=True)
class Change:
    """A wrong change of a file of the package.

    Attributes:
        name: what it does wrong.
        file: below the root of the repository.
        old: the text that is replaced.
        new: the text that takes its place.
        line: the number of the first line of ``old``; 0 where the file has the text only once.
        tests: files and folders of tests that are to notice it, in their order.
    """

    name: str
    file: str
    old: str
    new: str
    line: int = 0
    tests: tuple[str, ...] = ()

    def applied(self, text: str) -> str:
        """Return the file's text with the change; of equal places the one nearest to ``line``.

        Raises:
            ValueError: the text is not there, or not only once where no line is given.
        """
        places = [i for i in range(len(text)) if text.startswith(self.old, i)]
        if not places or (len(places) > 1 and not self.line):
            raise ValueError(f"{self.file}: has {len(places)} times: {self.old!r}")
        at = min(places, key=lambda i: abs(text.count("\n", 0, i) + 1 - self.line))
        return text[:at] + self.new + text[at + len(self.old) :]


def reasons() -> dict[tuple[str, str], str]:
    """Return why no test is to notice a change, by its file and new text, where that is known."""
    rows = yaml.safe_load(SURVIVORS.read_text(encoding="utf-8"))
    return {(row["file"], row["new"]): row["reason"] for row in rows}


def listed() -> list[Change]:
    """Return the known changes that tests must notice."""
    rows = yaml.safe_load(LIST.read_text(encoding="utf-8"))
    return [Change(**row | {"tests": tuple(row["tests"])}) for row in rows]
