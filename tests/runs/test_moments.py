"""The files of a stream's moments: what is read is what was written, and from which files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays
from kernel_checks import generator
from kills_in_place import kill_everywhere
from torch import Tensor

from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.runs import moments, steps, stream
from gsdmsr_cli.runs.moments import Rounding

COUNT, MOMENTS = 40, 8
ROUNDING = Rounding(place_step=1e-3, turn_step=1e-2, keyframe_every=3)
TOLD = {"step": 7, "progress": 0.5, "elapsed": 1.5}


def values_at(moment: int) -> dict[str, Tensor]:
    """Splats that go steadily, and tremble."""
    rng = generator(moment)
    offsets = 0.05 * moment + 0.01 * torch.randn(COUNT, 3, generator=rng)
    return {"offsets": offsets, "turns": 0.1 * torch.randn(COUNT, 4, generator=rng)}


def splats() -> dict[str, Tensor]:
    shapes = {"means": (3,), "quats": (4,), "log_scales": (3,), "logit_opacities": (), "sh": (1, 3)}
    rng = generator()
    return {f"splats.{n}": torch.randn(COUNT, *s, generator=rng) for n, s in shapes.items()}


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """A run folder of a stream of so many moments."""
    moments.write_first(tmp_path, splats(), COUNT, 0.0, TOLD)
    for moment in range(1, MOMENTS):
        moments.write(tmp_path, moment, moment / (MOMENTS - 1), values_at(moment), ROUNDING, TOLD)
    return tmp_path


def assert_near(found: dict[str, Tensor], truth: dict[str, Tensor]) -> None:
    for name, step in (("offsets", ROUNDING.place_step), ("turns", ROUNDING.turn_step)):
        worst = (found[name] - truth[name]).abs().max()
        assert worst <= step / 2 + 1e-6, name


@given(
    arrays(
        np.int64,
        array_shapes(min_dims=2, max_dims=2, min_side=0, max_side=6),
        elements=st.integers(-(2**31) + 1, 2**31 - 1),
    )
)
@settings(deadline=None)
def test_whole_numbers_come_back(levels: np.ndarray) -> None:
    np.testing.assert_array_equal(steps.decode(*steps.encode(levels)), levels)


def test_every_moment_is_within_half_a_step_however_far_it_is_from_the_first(root: Path) -> None:
    for moment in range(1, MOMENTS):
        assert_near(moments.tracks_of(root, moments.read(root, moment)), values_at(moment))


def test_a_moment_is_read_from_its_own_file_and_that_of_its_keyframe(root: Path) -> None:
    for moment in (1, 4, 5, 6):
        key = moment - moment % ROUNDING.keyframe_every
        kept = {key, moment}
        for other in set(range(MOMENTS)) - kept:
            path = moments.path_of(root, other)
            path.rename(path.with_suffix(".away"))
        assert_near(moments.tracks_of(root, moments.read(root, moment)), values_at(moment))
        for path in list((root / moments.FOLDER).glob("*.away")):
            path.rename(path.with_suffix(".safetensors"))


def test_what_stands_still_takes_next_to_no_bytes(tmp_path: Path) -> None:
    still = {"offsets": torch.zeros(5000, 3), "turns": torch.zeros(5000, 4)}
    moved = {name: tensor + torch.randn(tensor.shape) for name, tensor in still.items()}
    sizes = [moments.write(tmp_path, 1, 0.5, values, ROUNDING, TOLD) for values in (still, moved)]
    assert sizes[0] < 1500 and 30_000 < sizes[1] < 5000 * 7 * 2
    assert sizes[1] == moments.path_of(tmp_path, 1).stat().st_size


def test_all_moments_together_are_the_single_ones(root: Path) -> None:
    found = stream.load(root)
    expected = splats()
    assert all(torch.equal(found.tensors[name], tensor) for name, tensor in expected.items())
    assert found.tensors["motion.times"].tolist() == [i / (MOMENTS - 1) for i in range(MOMENTS)]
    for name in moments.TRACKS:
        past = found.tensors[f"motion.past_{name}"]
        whole = torch.cat([past, found.tensors[f"motion.{name}"][:, None]], dim=1)
        for moment in range(1, MOMENTS):
            own = moments.tracks_of(root, moments.read(root, moment))[name]
            assert torch.equal(whole[:, moment - 1], own)
    assert (found.step, found.progress, found.elapsed) == (7, 0.5, 1.5)
    files = [path.stat().st_size for path in (root / moments.FOLDER).iterdir()]
    assert found.file_bytes == sum(files) and found.packed is not None
    assert found.packed["motion.moments"] == sum(files) - moments.path_of(root, 0).stat().st_size


def test_a_stream_of_one_moment_stands_still(tmp_path: Path) -> None:
    moments.write_first(tmp_path, splats(), COUNT, 0.25, TOLD)
    found = stream.load(tmp_path).tensors
    assert found["motion.times"].tolist() == [0.25, 0.25]
    assert found["motion.past_turns"].shape == (COUNT, 0, 4) and not found["motion.offsets"].any()


def test_a_moment_that_is_no_keyframe_may_be_missing(root: Path) -> None:
    moments.path_of(root, 4).unlink()
    assert len(stream.load(root).tensors["motion.times"]) == MOMENTS - 1


@pytest.mark.parametrize("missing", [0, 3])
def test_a_missing_keyframe_is_named(root: Path, missing: int) -> None:
    moments.path_of(root, missing).unlink()
    with pytest.raises(DataError, match=f"00000{missing}.safetensors"):
        stream.load(root)


def test_a_damaged_file_is_named_wherever_it_is_damaged(root: Path) -> None:
    path = moments.path_of(root, 4)
    whole = path.read_bytes()
    header = 8 + int.from_bytes(whole[:8], "little")
    for at in (0, 9, header - 20, header + 40, len(whole) - 30):
        path.write_bytes(whole[:at] + bytes([whole[at] ^ 0x5A]) + whole[at + 1 :])
        try:
            stream.load(root)
        except DataError as error:
            assert "\n" not in str(error) and "moments" in str(error)
    for length in (0, 7, header - 1, header + 1, len(whole) - 1):
        path.write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"000004\.safetensors: damaged"):
            stream.load(root)


def test_the_file_of_another_moment_is_refused(root: Path) -> None:
    moments.path_of(root, 5).write_bytes(moments.path_of(root, 4).read_bytes())
    with pytest.raises(DataError, match=r"000005\.safetensors: damaged: it says .*moment 4"):
        stream.load(root)


def test_files_from_a_moment_on_are_removed_and_no_others(root: Path) -> None:
    mine = root / moments.FOLDER / "notes.txt"
    mine.write_text("mine")
    moments.rewind(root, 3)
    assert moments.there(root) == [0, 1, 2] and mine.is_file()
    mine.unlink()
    moments.rewind(root, 0)
    assert not (root / moments.FOLDER).exists()
    moments.rewind(root, 0)


def test_values_that_are_not_finite_are_not_written(tmp_path: Path) -> None:
    values = values_at(1)
    values["turns"][3, 2] = torch.nan
    with pytest.raises(ValueError, match="not finite"):
        moments.write(tmp_path, 1, 0.5, values, ROUNDING, TOLD)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="processes cannot be forked here")
def test_a_write_that_is_killed_at_any_call_leaves_the_moments_before(root: Path) -> None:
    before = stream.load(root).tensors["motion.offsets"]

    def work() -> None:
        moments.write(root, MOMENTS, 1.0, values_at(MOMENTS), ROUNDING, TOLD)

    def check() -> None:
        there = moments.there(root)
        assert there in ([*range(MOMENTS)], [*range(MOMENTS + 1)])
        assert len(stream.load(root).tensors["motion.times"]) == len(there)
        moments.rewind(root, MOMENTS)
        assert torch.equal(stream.load(root).tensors["motion.offsets"], before)
        assert not [path for path in root.rglob("*") if ".part" in path.name]

    assert kill_everywhere(work, root, check) >= 6
    assert moments.there(root) == [*range(MOMENTS + 1)]
