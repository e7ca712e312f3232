"""Tables of integers survive their coding, and damaged ones are named."""

from __future__ import annotations

import json
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from gsdmsr_cli.moving.container import MAGIC, from_bytes, to_bytes
from gsdmsr_cli.moving.parts import (
    Part,
    integers_of,
    packed,
    part_of,
    plain_table,
    signed_table,
    values_of,
)
from gsdmsr_cli.moving.places import code_places, places_of

tables = st.integers(0, 2**32 - 1).map(
    lambda seed: (
        lambda rng: (
            rng.normal(size=(rng.integers(1, 40), rng.integers(1, 5))) * 10.0 ** rng.integers(-3, 4)
        )
    )(np.random.default_rng(seed))
)


def written_by_hand(columns: list[list[int]], width: int) -> bytes:
    """Return a stream as docs/file-format.md says it, without the code that is tested."""
    planes = b""
    for column in columns:
        for place in range(width):
            planes += bytes(value >> 8 * place & 255 for value in column)
    return zlib.compress(planes)


def test_a_stream_is_what_the_format_says() -> None:
    columns, expected = [[1, 300, 70000], [0, 5, 6]], [[1, 0], [300, 5], [70000, 6]]
    part = Part("a", 3, 2, 3, False, False, (0.5, 1), (2, 10), {}, written_by_hand(columns, 3))
    assert integers_of(part).tolist() == expected
    assert values_of(part).tolist() == [[2.5, 1], [600.5, 51], [140000.5, 61]]


def test_signs_and_differences_are_what_the_format_says() -> None:
    stream = written_by_hand([[4, 3, 1, 0]], 1)
    signed = Part("a", 4, 1, 1, True, False, (0,), (1,), {}, stream)
    assert integers_of(signed)[:, 0].tolist() == [2, -2, -1, 0]
    differences = replace(signed, signed=False, difference=True)
    assert integers_of(differences)[:, 0].tolist() == [2, 0, -1, -1]


@given(tables, st.floats(1e-3, 10.0))
def test_values_come_back_within_half_a_step(values: NDArray[np.float64], step: float) -> None:
    part = packed(plain_table("a", values, step))
    described = json.loads(json.dumps(part.described()))
    again = values_of(part_of(described, part.stream))
    slack = 1e-5 * np.abs(values).max()
    assert np.abs(again - values).max() <= 0.5001 * part.step[0] + slack


@given(st.lists(st.integers(-(2**40), 2**40), min_size=1, max_size=30))
def test_signed_integers_come_back(numbers: list[int]) -> None:
    q = np.array(numbers)[:, None]
    assert (integers_of(packed(signed_table("a", q, 1.0))) == q).all()


def test_integers_of_more_than_six_bytes_are_refused() -> None:
    with pytest.raises(ValueError, match="7 bytes"):
        packed(signed_table("a", np.array([[2**50]]), 1.0))


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.5, 2.0]))
def test_places_come_back_in_another_order(seed: int, warp: float) -> None:
    rng = np.random.default_rng(seed)
    count = int(rng.integers(0, 50))
    moving, means = int(rng.integers(0, count + 1)), rng.normal(size=(count, 3)) * 3
    table, order = code_places(means, moving, 1e-3, warp)
    part = packed(table)
    assert sorted(order[:moving].tolist()) == list(range(moving))
    again = places_of(part, moving)
    assert again.shape == (count, 3)
    steps = part.step[0] * np.cosh(np.arcsinh(means[order] / warp)) * warp
    assert (np.abs(again - means[order]) <= 0.51 * steps + 1e-5).all()


def test_one_place_and_many_at_one_place_are_coded() -> None:
    for count in (1, 5):
        table, _ = code_places(np.full((count, 3), 0.25), count, 1e-3, 1.0)
        assert np.allclose(places_of(packed(table), count), 0.25, atol=1e-5)


def a_file() -> bytes:
    return to_bytes({"splats": 3}, [packed(plain_table("a", np.arange(6.0).reshape(3, 2), 1.0))])


def test_a_file_comes_back() -> None:
    header, parts = from_bytes(a_file())
    assert header["splats"] == 3 and list(parts) == ["a"]
    assert values_of(parts["a"]).tolist() == [[0, 1], [2, 3], [4, 5]]


@pytest.mark.parametrize("length", range(0, len(a_file()), 7))
def test_a_file_that_is_cut_short_is_refused(length: int) -> None:
    with pytest.raises(ValueError, match=r"cut short|is not a \.dsplat file"):
        from_bytes(a_file()[:length])


def test_a_newer_version_is_named() -> None:
    data = bytearray(a_file())
    data[len(MAGIC)] = 7
    with pytest.raises(ValueError, match="version 7; this program reads 1"):
        from_bytes(bytes(data))


@pytest.mark.parametrize(
    "header",
    [b"[]", b"{", b'{"parts": 3}', b'{"parts": [{"name": "a"}]}', b"\xff", b'{"parts": [[]]}'],
)
def test_a_damaged_header_is_refused(header: bytes) -> None:
    data = MAGIC + (1).to_bytes(4, "little") + len(header).to_bytes(4, "little") + header
    with pytest.raises(ValueError, match="damaged header"):
        from_bytes(data)


def test_a_damaged_stream_is_refused() -> None:
    _, parts = from_bytes(a_file())
    part = parts["a"]
    for stream in (b"nothing", zlib.compress(bytes(5)), zlib.compress(bytes(10**6))):
        with pytest.raises(ValueError, match="part 'a'"):
            integers_of(replace(part, stream=stream))
