"""In which format fields compute on a GPU: chosen around a call, as torch.autocast is."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch

FORMATS = {"float32": torch.float32, "bf16": torch.bfloat16, "fp16": torch.float16}

_chosen: ContextVar[torch.dtype] = ContextVar("precision", default=torch.float32)


@contextmanager
def computing_in(name: str) -> Iterator[None]:
    """Let lookups and networks on a GPU compute in a format; on the CPU they stay float32."""
    before = _chosen.set(FORMATS[name])
    try:
        yield
    finally:
        _chosen.reset(before)


def chosen() -> torch.dtype:
    """Return the format that has been chosen, float32 by default."""
    return _chosen.get()
