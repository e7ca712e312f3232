"""Packed values come back to within their bits, take few bytes where neighbours are alike."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from kernel_checks import generator
from numpy.typing import NDArray

from gsdmsr_cli.runs import packed_values
from gsdmsr_cli.runs.packed_values import CODES, HALF, RAW, Form, decode, encode, rounded

SHAPES = (), (5,), (7, 3), (0, 3), (2, 3, 4, 16), (40, 0)


def values_of(shape: tuple[int, ...]) -> NDArray[Any]:
    return torch.randn(shape, generator=generator(3)).numpy()


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("bits", [1, 4, 8, 9, 16])
def test_steps_come_back_to_within_half_a_step(bits: int, shape: tuple[int, ...]) -> None:
    values = values_of(shape)
    found = decode(*encode(values, Form("steps", bits)))
    assert found.shape == values.shape and found.dtype == np.float32
    assert np.array_equal(found, rounded(values, Form("steps", bits)))
    if values.size:
        half = 0.5 * np.ptp(values) / (2**bits - 1)
        assert np.abs(found - values).max() <= 1.001 * half + 1e-6


@pytest.mark.parametrize("shape", SHAPES)
def test_halves_and_raw_values_come_back(shape: tuple[int, ...]) -> None:
    values = values_of(shape)
    assert np.array_equal(decode(*encode(values, RAW)), values)
    halves = values.astype(np.float16).astype(np.float32)
    for found in (decode(*encode(values, HALF)), rounded(values, HALF)):
        assert np.array_equal(found, halves) and found.dtype == np.float32
    whole = np.arange(5)
    found = decode(*encode(whole, RAW))
    assert np.array_equal(found, whole) and found.dtype == whole.dtype


def test_codes_come_back() -> None:
    codes = torch.randint(256, (20, 3), generator=generator(3)).numpy().astype(np.uint8)
    assert np.array_equal(decode(*encode(codes, CODES)), codes)


@pytest.mark.parametrize("bits", [6, 12])
@pytest.mark.parametrize("axis", [0, 1])
def test_what_neighbours_share_is_stored_once(axis: int, bits: int) -> None:
    """Sums of noise along one axis; in another order they are only noise."""
    form = Form("steps", bits)
    smooth = np.cumsum(values_of((2000, 40)), axis=axis, dtype=np.float32)
    data, about = encode(smooth, form)
    assert about["along"] == axis
    assert np.array_equal(decode(data, about), rounded(smooth, form))
    mixed = smooth.ravel()[torch.randperm(smooth.size, generator=generator(1)).numpy()]
    plain, about = encode(mixed.reshape(smooth.shape), form)
    assert about["along"] is None
    assert data.nbytes < 0.85 * plain.nbytes


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("shape", [(40, 4), (4, 40)])
def test_differences_wrap_around_and_come_back(shape: tuple[int, int], bits: int) -> None:
    """From the least to the largest value and back, which no signed difference can tell."""
    ends = np.array([0, 2**bits - 1] * 80, np.dtype(f"<u{bits // 8}")).reshape(shape)
    for axis in (0, 1):
        folded = packed_values._differences(ends, axis)
        assert np.array_equal(packed_values._sums(folded, axis), ends)


def test_equal_values_stay_what_they_are() -> None:
    """As the masks of a packed model do, which take next to no bytes."""
    data, about = encode(np.full(10000, 1.25, np.float32), Form("steps", 4))
    assert data.nbytes < 130
    assert np.array_equal(decode(data, about), np.full(10000, 1.25))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shape": [8, 3]}, "has not the 24 bytes"),
        ({"shape": [6, 3]}, "has not the 18 bytes"),
        ({"shape": [-1, 3]}, "nothing is packed as"),
        ({"kind": "pickle"}, "nothing is packed as 'pickle'"),
        ({"bits": 0}, "0 bits a value"),
        ({"bits": 17}, "17 bits a value"),
        ({"bits": 9}, "has not the 42 bytes"),
    ],
    ids=str,
)
def test_what_is_described_otherwise_is_refused(change: dict[str, Any], message: str) -> None:
    data, about = encode(values_of((7, 3)), Form("steps", 8))
    with pytest.raises(ValueError, match=message):
        decode(data, about | change)


def test_damage_is_found_by_its_checksum() -> None:
    data, about = encode(values_of((70, 3)), Form("steps", 8))
    for place in range(8, len(data)):
        changed = data.clone()
        changed[place] ^= 4
        with pytest.raises(ValueError, match="packed data"):
            decode(changed, about)
