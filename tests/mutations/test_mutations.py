"""That the known wrong changes can still be made, and which changes are made by rule."""

from __future__ import annotations

import ast

import pytest
from beside import find_tests
from changes import ROOT, Change, is_kernel, listed
from small_changes import change_of, edits

SOURCE = '''"""Says something."""

def reach(points: int = 3, *, wide: bool = False) -> float:
    """Return a number."""
    if points < 2 and not wide:
        raise ValueError(f"too few: {points + 1}")
    values.append(min(points, 7))
    return 0.5 * len(values, key=points)
'''


@pytest.mark.parametrize("change", listed(), ids=lambda change: change.name)
def test_a_known_change_has_its_place_and_its_tests(change: Change) -> None:
    text = (ROOT / change.file).read_text(encoding="utf-8")
    changed = change.applied(text)
    assert changed != text
    ast.parse(changed)
    assert all((ROOT / test).exists() for test in change.tests)


def test_small_changes_are_made_of_all_that_is_done() -> None:
    changed = {change_of("a.py", SOURCE, edit).applied(SOURCE) for edit in edits(SOURCE)}
    expected = [
        ("points: int = 3", "points: int = 4"), ("points: int = 3", "points: int = 0"),
        ("wide: bool = False", "wide: bool = True"), ("points < 2", "points <= 2"),
        ("points < 2", "points > 2"), ("points < 2", "points < 3"), ("points < 2", "points < 0"),
        (" and not", " or not"), ("not wide", " wide"), ("points < 2 and not wide",
        "not (points < 2 and not wide)"), ("values.append(min(points, 7))", "pass"),
        ("min(", "max("), ("points, 7", "7, points"), ("7))", "8))"), ("7))", "0))"),
        ("0.5 *", "0.5 /"), ("0.5 *", "1.5 *"), ("0.5 *", "0.0 *"), (", key=points", ""),
    ]  # fmt: skip
    assert changed == {SOURCE.replace(old, new) for old, new in expected}


def test_the_nearest_of_equal_places_is_changed() -> None:
    text = "a\nb\na\nb\n"
    assert Change("", "x.py", "a", "c", line=3).applied(text) == "a\nb\nc\nb\n"
    with pytest.raises(ValueError, match="has 2 times"):
        Change("", "x.py", "a", "c").applied(text)


def test_kernels_are_told_apart() -> None:
    assert is_kernel("gsdmsr_cli/ops/adam/cpu.py") and is_kernel("gsdmsr_cli/ground/ssim.py")
    assert not is_kernel("gsdmsr_cli/raster/cpu.py")


def test_tests_of_a_file_come_before_those_of_its_folder_and_of_others() -> None:
    found = find_tests(ROOT, "gsdmsr_cli/training/population/density.py")
    assert found[0] == "tests/training/population/test_density.py"
    assert "tests/training/population/test_thinning.py" in found
    assert found[-1].startswith("tests/runs/") and len(found) == len(set(found))
