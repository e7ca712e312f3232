"""Where output goes that nobody gets: a pipe whose reader has left, and a full disk."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

SINKS = ["a pipe without a reader", "a full disk"]


@contextmanager
def sink(kind: str) -> Iterator[int]:
    """Yield a descriptor that cannot be written, one of ``SINKS``."""
    if kind == SINKS[0]:
        reader, descriptor = os.pipe()
        os.close(reader)
    elif Path("/dev/full").exists():
        descriptor = os.open("/dev/full", os.O_WRONLY)
    else:
        pytest.skip("no /dev/full here")
    try:
        yield descriptor
    finally:
        os.close(descriptor)
