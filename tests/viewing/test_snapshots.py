"""Snapshots are written while somebody looks, and seldom enough."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from gsdmsr_cli.viewing.snapshots import (
    EVERY,
    FRESH,
    SHARE,
    Snapshots,
    forget,
    mark,
    snapshot_path,
)


class Clock:
    def __init__(self) -> None:
        self.time = 1e9

    def __call__(self) -> float:
        return self.time


@pytest.fixture
def clock() -> Clock:
    return Clock()


def snapshots_of(root: Path, clock: Clock, cost: float = 0.0) -> tuple[Snapshots, list[float]]:
    made = list[float]()

    def make() -> bytes:
        clock.time += cost
        made.append(clock.time)
        return b"splats"

    return Snapshots(root, make, clock), made


def looked_at(root: Path, clock: Clock) -> None:
    mark(root)
    os.utime(root / "view" / "wanted", (clock.time, clock.time))


def test_none_is_made_while_nobody_looks(tmp_path: Path, clock: Clock) -> None:
    snapshots, made = snapshots_of(tmp_path, clock)
    for _ in range(5):
        clock.time += 100
        assert not snapshots.offer()
    assert not made and not snapshot_path(tmp_path).exists()


def test_one_is_written_while_somebody_looks(tmp_path: Path, clock: Clock) -> None:
    snapshots, made = snapshots_of(tmp_path, clock)
    looked_at(tmp_path, clock)
    assert snapshots.offer()
    assert snapshot_path(tmp_path).read_bytes() == b"splats"
    clock.time += EVERY - 0.1
    looked_at(tmp_path, clock)
    assert not snapshots.offer()  # too soon
    clock.time += 0.2
    assert snapshots.offer() and len(made) == 2
    clock.time += FRESH + EVERY
    assert not snapshots.offer()  # nobody looks any more


def test_they_take_no_more_than_their_share(tmp_path: Path, clock: Clock) -> None:
    snapshots, made = snapshots_of(tmp_path, clock, cost=2.0)
    began = clock.time
    for _ in range(300):
        clock.time += 1.0
        looked_at(tmp_path, clock)
        snapshots.offer()
    assert len(made) > 3
    assert 2.0 * (len(made) - 1) <= SHARE * (clock.time - began)


def test_what_was_written_is_forgotten(tmp_path: Path, clock: Clock) -> None:
    snapshots, _ = snapshots_of(tmp_path, clock)
    looked_at(tmp_path, clock)
    snapshots.offer()
    forget(tmp_path)
    assert list(tmp_path.iterdir()) == []
    forget(tmp_path)  # there is nothing: that is fine


def test_a_folder_that_cannot_be_written_is_no_error(tmp_path: Path) -> None:
    (tmp_path / "view").write_text("a file where the folder would be", encoding="utf-8")
    mark(tmp_path)
    forget(tmp_path)
    assert (tmp_path / "view").is_file()
