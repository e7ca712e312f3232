"""The command line understands every example in the pages of the documentation."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

Gsdmsr = Any  # the fixture of conftest.py

ROOT = Path(__file__).parents[2]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])


def examples(page: Path) -> list[str]:
    """Return the calls of gsdmsr in a page's blocks of code, but for those that tell of syntax."""
    blocks = re.findall(r"^```\w*\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    calls = (re.split(r"\s[#|]", line)[0].strip().removeprefix("- run: ") for line in lines)
    syntax = re.compile(r"\[|\s[A-Z]+\b")
    return [call for call in calls if call.startswith("gsdmsr ") and not syntax.search(call)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_the_command_line_understands_the_examples_in_pages(page: Path, gsdmsr: Gsdmsr) -> None:
    for call in examples(page):
        assert gsdmsr(call.removeprefix("gsdmsr ")) == 0, call
