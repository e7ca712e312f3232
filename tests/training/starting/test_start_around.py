"""Where the splats of a rig start follows from how its cameras stand."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from kernel_checks import generator
from standing import PANEL, rig

from gsdmsr_cli.demo.synthetic import camera_on_dome
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.options.preset import SplatOptions, load_preset
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.training.starting.initial import initial_splats


def test_a_rig_around_starts_in_the_box_where_the_preset_says_so() -> None:
    """From the box no pictures are read, of which there are none here."""
    around = rig([camera_on_dome(angle, 0.6, 32) for angle in (0.0, 1.5, 3.0)])
    options = SplatOptions(start="surfaces", start_around="box", count=50)
    given = Pictures((1.0, 1.0, 1.0), 1, 0), torch.ones(3), generator(0), 100
    splats, times = initial_splats(around, options, *given)
    assert len(splats) == 50 and splats.means.abs().max() <= around.bound and times.isnan().all()
    for other in (rig(PANEL), options), (around, replace(options, start_around=None)):
        with pytest.raises(DataError, match=r"image \. does not exist"):
            initial_splats(*other, *given)


@pytest.mark.parametrize("name", ["n3v", "persistent", "hicom", "scale-gs", "3dgstream"])
def test_presets_for_rigs_look_how_cameras_stand(name: str) -> None:
    splats = load_preset(name, None, []).splats
    assert splats.start == "surfaces" and splats.start_around in {"box", "silhouettes"}
