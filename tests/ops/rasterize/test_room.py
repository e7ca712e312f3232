"""Room for lists of unknown length: enough in the long run, and what is short is counted."""

from __future__ import annotations

import torch
from hypothesis import given
from hypothesis import strategies as st

from gsdmsr_cli.backends.cuda import recording
from gsdmsr_cli.ops.rasterize.cuda.room import LEAST, MARGIN, WINDOW, Room

LARGE = 100 * LEAST


def find(room: Room, length: int, rows: int = 1000, exact: bool = False, kind: str = "a") -> int:
    return room.find(torch.tensor(length), kind, rows, exact)


def test_exact_room_is_the_length_and_never_nothing() -> None:
    room = Room()
    assert [find(room, n, exact=True) for n in (0, 7, LARGE)] == [1, 7, LARGE]


@given(st.integers(0, 10**9))
def test_the_first_list_of_a_kind_has_room(length: int) -> None:
    assert find(Room(), length) >= max(MARGIN * length, LEAST)


def test_a_list_that_grows_too_fast_loses_its_end_once() -> None:
    room = Room()
    find(room, LARGE)
    assert find(room, 3 * LARGE) < 3 * LARGE
    assert room.overflows == 0  # it is known when the length has been read
    assert find(room, 3 * LARGE) >= 3 * LARGE
    assert room.overflows == 1
    assert find(room, 3 * LARGE) >= 3 * LARGE
    assert room.overflows == 1


def test_guesses_follow_the_number_of_rows() -> None:
    room = Room()
    find(room, LARGE, rows=1000)
    assert find(room, 2 * LARGE, rows=2000) >= 2 * LARGE
    assert find(room, 2 * LARGE, rows=2000) >= 2 * LARGE
    assert room.overflows == 0


def test_kinds_know_nothing_of_one_another() -> None:
    room = Room()
    find(room, LARGE, kind="a")
    assert find(room, 4 * LARGE, kind="b") >= 4 * LARGE


def test_rooms_are_of_few_sizes() -> None:
    sizes = {find(Room(), LARGE + i) for i in range(0, LARGE, LARGE // 1000)}
    assert len(sizes) <= 12


def test_room_follows_lists_that_have_become_shorter() -> None:
    """Late in a training splats are small: the room is not that of the longest list ever."""
    room = Room()
    find(room, 14 * LARGE)
    for _ in range(WINDOW + 1):
        find(room, LARGE)
    assert LARGE <= find(room, LARGE) <= 1.2 * MARGIN * LARGE
    assert room.overflows == 0


def test_room_is_that_of_the_longest_of_the_last_lists() -> None:
    """Views differ: one that is seldom drawn keeps its room until the window has passed it."""
    room = Room()
    for _ in range(3):
        find(room, 4 * LARGE)
        for _ in range(WINDOW - 2):
            find(room, LARGE)
    assert room.overflows == 0


def test_lists_that_grow_again_lose_their_end_once() -> None:
    room = Room()
    for length in (14 * LARGE, *[LARGE] * (WINDOW + 1), 14 * LARGE):
        find(room, length)
    assert find(room, 14 * LARGE) >= 14 * LARGE
    assert room.overflows == 1


class Followed:
    """Listens while work is recorded."""

    def __init__(self) -> None:
        self.lists: list[recording.Followed] = []

    def listens(self) -> bool:
        return True

    def follow(self, what: recording.Followed) -> None:
        self.lists.append(what)


def test_a_recorded_list_keeps_its_room_and_is_recorded_anew_when_that_is_short() -> None:
    room, length, followed = Room(), torch.tensor(LARGE), Followed()
    found = room.find(length, "a", 1000, False)
    with recording.recorded_by(followed):  # type: ignore[arg-type]
        assert room.find(length, "a", 1000, False) == found
    (recorded,) = followed.lists
    assert recorded.is_good()
    for now, good in ((found // 2, True), (found, True), (found + 1, False)):
        length.fill_(now)  # what a replay writes
        recorded.replayed()
        assert recorded.is_good() is good
    assert room.overflows == 1
    assert room.find(length, "a", 1000, False) > found


def test_nothing_is_asked_of_the_gpu_while_a_list_is_recorded() -> None:
    """An event that is asked while a stream is captured spoils the capture."""

    class Untouchable:
        def query(self) -> bool:
            raise AssertionError("asked")

    room, length = Room(), torch.tensor(LARGE)
    room.find(length, "a", 1000, False)
    for news in room._news.values():
        news[:] = [one._replace(arrived=Untouchable()) for one in news]
    with recording.recorded_by(Followed()):  # type: ignore[arg-type]
        assert room.find(length, "a", 1000, False) >= LARGE
