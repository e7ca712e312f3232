"""Which trainings several ranks can share."""

from __future__ import annotations

import pytest

from gsdmsr_cli.commands._party import Party, require_suited
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.options.preset import Preset, load_preset
from gsdmsr_cli.training.ranks.alone import Ranks


class Two(Ranks):
    """The first of two ranks, which does not meet the other."""

    rank, size = 0, 2


def options(*overrides: str, name: str = "dnerf") -> Preset:
    return load_preset(name, None, overrides)


@pytest.mark.parametrize(
    ("preset", "device", "message"),
    [
        (options(), "cuda", "2 ranks train on CPUs alone"),
        (options("training.views_per_step=1"), "cpu", "training.views_per_step is 1"),
        (options(name="persistent"), "cpu", "2 ranks cannot share a stream"),
    ],
)
def test_what_ranks_cannot_share_is_refused(preset: Preset, device: str, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        require_suited(Party(Two()), preset, device)
    require_suited(Party(), preset, device)


def test_two_views_can_be_shared_by_two() -> None:
    require_suited(Party(Two()), options("training.views_per_step=2"), "cpu")
