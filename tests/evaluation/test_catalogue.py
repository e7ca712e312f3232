"""Which metrics there are for pictures of a size, and why others have no value."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from gsdmsr_cli.evaluation.catalogue import METRICS, WHOLE, less_is_better, load_metrics
from gsdmsr_cli.evaluation.lpips import NETS
from gsdmsr_cli.evaluation.metrics import Missing, ms_ssim


@pytest.fixture
def _no_weights(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Hide the weights that this machine may have."""
    monkeypatch.delenv("GSDMSR_LPIPS_DIR", raising=False)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))


@pytest.mark.usefixtures("_no_weights")
def test_without_weights_the_reason_is_said() -> None:
    metrics = load_metrics((200, 200))
    assert metrics.pop("ms_ssim") is ms_ssim
    assert metrics.keys() == {f"lpips_{net}" for net in NETS}
    for metric in metrics.values():
        assert isinstance(metric, Missing) and metric.reason and metric.searched
    more = load_metrics((200, 200), published=True)
    assert more.keys() - metrics.keys() == {"ms_ssim", "lpips_alex_inria", "lpips_vgg_inria"}
    assert isinstance(more["lpips_vgg_inria"], Missing)


def test_pictures_too_small_are_a_reason(shared_data: Path) -> None:
    large, small = (load_metrics((side, 200), shared_data / "lpips", True) for side in (200, 8))
    there = [name for name, metric in large.items() if not isinstance(metric, Missing)]
    assert there == ["ms_ssim", "lpips_alex", "lpips_squeeze", "lpips_alex_inria"]
    for name in there:
        metric = small[name]
        assert isinstance(metric, Missing) and "pictures of 8 x 200 px" in metric.reason
    medium = load_metrics((175, 200), shared_data / "lpips")
    assert isinstance(medium["ms_ssim"], Missing) and "176 px a side" in medium["ms_ssim"].reason
    assert not isinstance(medium["lpips_alex"], Missing)


def test_the_published_variant_is_that_of_pictures_fed_as_they_are(shared_data: Path) -> None:
    """Halved contrasts around 0.75 on [0, 1] are whole pictures around 0.5 on [-1, 1]."""
    metrics = load_metrics((64, 64), shared_data / "lpips", published=True)
    own, published = metrics["lpips_alex"], metrics["lpips_alex_inria"]
    assert not isinstance(own, Missing) and not isinstance(published, Missing)
    generator = torch.Generator().manual_seed(2)
    x, y = (torch.rand(64, 64, 3, generator=generator) for _ in range(2))
    assert published(x, y) == pytest.approx(own(x / 2 + 0.5, y / 2 + 0.5), rel=1e-5)
    assert abs(published(x, y) - own(x, y)) > 0.01


def test_names_are_unique_and_only_distances_are_better_when_small() -> None:
    assert len(set(METRICS)) == len(METRICS) and METRICS[: len(WHOLE)] == WHOLE
    distances = {m for m in METRICS if "lpips" in m or "flicker" in m}
    assert {m for m in METRICS if less_is_better(m)} == distances
