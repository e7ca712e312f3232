"""Which pictures decide whether a metric can be computed."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from gsdmsr_cli.commands import _measure
from gsdmsr_cli.evaluation.request import Request


class Asked(Exception):  # noqa: N818  (no error: it ends what is not wanted)
    """What metrics were asked for."""


def test_metrics_are_asked_for_the_picture_with_the_shortest_side(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sizes = [(300, 200), (100, 400), (150, 120)]

    def load_metrics(size: tuple[int, int], *_: object) -> None:
        raise Asked(size)

    monkeypatch.setattr(_measure, "load_metrics", load_metrics)
    cameras = [SimpleNamespace(width=width, height=height) for width, height in sizes]
    pictures = SimpleNamespace(camera=lambda view: cameras[view])
    trained: Any = SimpleNamespace(
        scene=SimpleNamespace(split=lambda name: range(3)),
        renderer=SimpleNamespace(pictures=pictures),
    )
    with pytest.raises(Asked) as asked:
        _measure.measure(trained, Request())
    assert asked.value.args == ((100, 400),)
