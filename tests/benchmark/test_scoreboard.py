"""Rows of a table of trials, worked out by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from gsdmsr_cli.benchmark.scoreboard import COLUMNS, cells, markdown, rows_of
from gsdmsr_cli.benchmark.trials import Trial


def trial(scene: str, preset: str = "dnerf", seed: int = 0) -> Trial:
    return Trial(Path("data") / scene, preset, "2m", seed)


def document(psnr: float | None, lpips: float | None = 0.25) -> dict[str, Any]:
    return {
        "aggregate": {
            "psnr": psnr,
            "psnr_fitted": 31.0,
            "psnr_moving": 25.0,
            "ssim": 0.5,
            "lpips_alex": {"value": lpips},
        },
        "splits": {"test": {"psnr": psnr}, "train": {"psnr": 40.0}},
        "speed": {"fps": 100.0, "fps_raster": 150.0},
        "storage": {"splats_bytes": 2_000_000, "motion_bytes": 500_000, "training_state_bytes": 7},
        "training": {"splats": 10, "steps": 200, "train_s": 5.0, "peak_rss_mib": 300.0},
    }


def test_a_single_trial() -> None:
    (row,) = rows_of([(trial("lego"), document(30.0))])
    assert row == {
        "scene": "lego", "preset": "dnerf", "length": "2m", "trials": 1, "psnr": 30.0,
        "spread": None, "train_psnr": 40.0, "val_psnr": None, "test_psnr": 30.0,
        "psnr_fitted": 31.0, "psnr_moving": 25.0, "psnr_static": None, "ssim": 0.5,
        "lpips_alex": 0.25, "fps": 100.0, "fps_raster": 150.0,
        "model_mb": 2.5, "splats": 10, "steps": 200, "ms_per_step": 25.0,
        "peak_mib": 300.0,
    }  # fmt: skip


def test_seeds_share_a_row_and_tell_their_spread() -> None:
    scored = [(trial("lego", seed=s), document(p)) for s, p in enumerate((30.0, 31.0, 30.5))]
    (row,) = rows_of(scored)
    assert (row["trials"], row["psnr"], row["spread"]) == (3, 30.5, 1.0)


def test_scenes_are_averaged_with_equal_weight_for_each_preset() -> None:
    scored = [
        (trial("a"), document(30.0)),
        (trial("a", seed=1), document(32.0)),
        (trial("b"), document(41.0)),
        (trial("a", "static"), document(20.0)),
    ]
    rows = {(row["scene"], row["preset"]): row for row in rows_of(scored)}
    single, means = [("a", "dnerf"), ("b", "dnerf"), ("a", "static")], ["dnerf", "static"]
    assert list(rows) == [*single, *(("mean", preset) for preset in means)]
    assert rows["mean", "dnerf"]["psnr"] == 36.0
    assert (rows["mean", "dnerf"]["trials"], rows["mean", "dnerf"]["spread"]) == (2, None)


def test_a_value_that_a_trial_lacks_is_none_for_the_row() -> None:
    scored = [(trial("a"), document(None, 0.1)), (trial("a", seed=1), document(30.0, None))]
    (row,) = rows_of(scored)
    assert (row["psnr"], row["spread"], row["lpips_alex"]) == (None, None, None)
    assert cells(row)[4:6] == ["", ""]


@pytest.mark.parametrize("count", [1, 3])
def test_the_table_has_a_line_for_every_row(count: int) -> None:
    scored = [(trial(f"s{i}"), document(30.0)) for i in range(count)]
    lines = markdown(rows_of(scored)).splitlines()
    assert len(lines) == 2 + count + (count > 1)
    assert lines[0].startswith("| scene | preset | length | trials | psnr | spread |")
    assert {line.count("|") for line in lines} == {5 + len(COLUMNS)}
    values = [
        "1",
        "30.00",
        "",
        "40.00",
        "",
        "30.00",
        "31.00",
        "25.00",
        "",
        "0.5000",
        "0.2500",
        "100",
        "150",
        "2.50",
        "10",
        "200",
        "25.0",
        "300",
    ]
    assert lines[2] == f"| {' | '.join(['s0', 'dnerf', '2m', *values])} |"
