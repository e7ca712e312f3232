"""Models of segments: which of them is drawn when, and how one goes over into the next."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from kernel_checks import generator
from motion_checks import disturbed, model_of, splats_at, splats_of, started
from torch import Tensor
from view_checks import camera_at

from gsdmsr_cli.drawing.splatting import draw
from gsdmsr_cli.model.joined import Joined, name_in, own_name
from gsdmsr_cli.model.layer import Instant
from gsdmsr_cli.model.model import STORED, Model
from gsdmsr_cli.raster import load_engine
from gsdmsr_cli.scene.segments import cut

COUNTS = 5, 7, 6
SEGMENTS = cut(3, 0.4)
BEHIND = torch.tensor([0.2, 0.5, 0.9])
CAMERA = camera_at(4.0, 0.0)


def moving(count: int, seed: int) -> Model:
    splats = splats_of(count, seed)
    splats = replace(splats, log_scales=splats.log_scales.clamp(-2, -1))
    return model_of(splats, disturbed(started("hexplane", count)))


@pytest.fixture
def joined() -> Joined:
    return Joined(SEGMENTS, [moving(count, seed) for seed, count in enumerate(COUNTS)])


def picture(model: Model, time: float) -> Tensor:
    with torch.no_grad():
        return draw(model, CAMERA, time, load_engine("cpu"), BEHIND).rgb


@pytest.mark.parametrize(("number", "within"), [(0, 0.0), (0, 0.4), (1, 0.5), (2, 0.7), (2, 1.0)])
def test_within_one_segment_its_own_model_is_drawn(
    joined: Joined, number: int, within: float
) -> None:
    segment, own = SEGMENTS[number], joined.models[number]
    time = segment.start + within * (segment.end - segment.start)
    torch.testing.assert_close(picture(joined, time), picture(own, within), rtol=0, atol=1e-5)
    found, expected = splats_at(joined, time), splats_at(own, within)
    torch.testing.assert_close(found.means, expected.means, rtol=0, atol=1e-5)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_where_two_count_the_picture_is_their_mean(joined: Joined, share: float) -> None:
    first, second = SEGMENTS[:2]
    time = second.start + share * (first.end - second.start)
    one, other = (picture(joined.models[i], SEGMENTS[i].within(time)) for i in (0, 1))
    expected = (1 - share) * one + share * other
    torch.testing.assert_close(picture(joined, time), expected, rtol=0, atol=1e-5)
    splats = splats_at(joined, time)
    assert len(splats) == COUNTS[0] + COUNTS[1]
    through = 1 - splats.logit_opacities.sigmoid()
    full = 1 - splats_at(joined.models[0], first.within(time)).logit_opacities.sigmoid()
    torch.testing.assert_close(through[: COUNTS[0]], full ** (1 - share), rtol=1e-4, atol=1e-6)


def test_pictures_do_not_jump(joined: Joined) -> None:
    ends = [end for segment in SEGMENTS for end in (segment.start, segment.end) if 0 < end < 1]
    for time in ends:
        before, after = (picture(joined, time + step) for step in (-1e-5, 1e-5))
        assert (before - after).abs().max() < 1e-3


def test_the_same_splats_go_on_to_a_later_instant(joined: Joined) -> None:
    time = SEGMENTS[0].end - 1e-3  # the second counts most
    for later in (time + 0.05, 1.0):
        now, then = (joined.lead(Instant(time), Instant(t)) for t in (time, later))
        assert now[0] is then[0] is joined.models[1]
        assert then[1].time == pytest.approx(SEGMENTS[1].within(later))


def test_its_tensors_tell_the_segments_apart(joined: Joined) -> None:
    tensors = joined.tensors()
    for i, model in enumerate(joined.models):
        for name, tensor in model.tensors().items():
            assert tensors[name_in(i, name)] is tensor
            assert own_name(name_in(i, name)) == name
    assert own_name(STORED[0]) == STORED[0]
    assert len(joined.splats) == joined.moving == sum(COUNTS)


def test_it_is_drawn_and_not_trained(joined: Joined) -> None:
    assert not joined.steady and joined.models[0].steady
    with pytest.raises(ValueError, match="one by one"):
        joined.at(Instant(0.5), torch.ones(sum(COUNTS), dtype=torch.bool))


def test_layers_see_times_of_their_own_segment(joined: Joined) -> None:
    rng = generator(3)
    for _ in range(20):
        time = float(torch.rand((), generator=rng))
        for share in joined.shares(Instant(time, jitter=0.25)):
            number = joined.models.index(share.model)
            assert share.instant.time == pytest.approx(SEGMENTS[number].within(time))
            assert share.instant.jitter == 0.25


def test_a_steady_model_has_all_splats_and_shows_those_that_count(
    joined: Joined,
) -> None:
    steady = joined.steadied()
    assert steady.steady and steady.steadied() is steady
    for time in (0.0, 0.2, *(segment.end for segment in SEGMENTS), 0.95):
        splats = splats_at(steady, time)
        assert len(splats) == sum(COUNTS)
        seen = splats.logit_opacities.sigmoid() > 1e-6
        assert torch.equal(splats.means[seen], splats_at(joined, time).means)
        assert torch.allclose(
            splats.logit_opacities[seen], splats_at(joined, time).logit_opacities, atol=1e-5
        )
