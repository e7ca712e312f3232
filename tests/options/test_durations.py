"""Durations as users write them."""

from __future__ import annotations

import pytest

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.options.durations import parse_duration


@pytest.mark.parametrize(
    ("text", "seconds"), [("90s", 90), ("8m", 480), ("2.5m", 150), ("1h", 3600), ("0.5s", 0.5)]
)
def test_durations(text: str, seconds: float) -> None:
    assert parse_duration(text) == seconds


@pytest.mark.parametrize(
    "text", ["", "8", "m", "-1m", "0s", "1d", "8 m", "1e3s", "1m30s", "9" * 400 + "h"]
)
def test_other_texts_are_no_durations(text: str) -> None:
    with pytest.raises(UsageError, match="is not a duration; allowed: "):
        parse_duration(text)
