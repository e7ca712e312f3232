"""Errors are of a length that a person reads."""

from __future__ import annotations

from gsdmsr_cli.ground.errors import LONGEST, DataError


def test_a_message_with_a_huge_name_keeps_its_beginning_and_its_end() -> None:
    text = str(DataError(f"run/{'a' * 100_000} does not exist; restore it"))
    assert len(text) <= LONGEST and text.startswith("run/aaa") and text.endswith("; restore it")
