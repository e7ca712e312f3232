"""Makes the initial splats from the scene's points or from random ones, and the layers' facts."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.model.layer import Facts
from gsdmsr_cli.ops.neighbours.cpu import mean_squares
from gsdmsr_cli.ops.planes import Box, Corner
from gsdmsr_cli.options.preset import SplatOptions
from gsdmsr_cli.runs.run import open_with_model
from gsdmsr_cli.scene.around import cameras_stand_around
from gsdmsr_cli.scene.pictures import Pictures
from gsdmsr_cli.scene.scene import Scene
from gsdmsr_cli.training.starting import changing, silhouettes, surfaces
from gsdmsr_cli.training.starting.sightings import Points, at_unknown_times, colours_of

NEIGHBOURS = 3

STRAYS, MARGIN = 0.01, 0.075
"""Share of the first splats that may lie beyond each side of the motion's box, and what is added
to the box on each side, in units of its edge."""


def initial_splats(
    scene: Scene,
    options: SplatOptions,
    pictures: Pictures,
    background: Tensor,
    generator: torch.Generator,
    most: int,
) -> tuple[Splats, Tensor]:
    """Return isotropic splats as large as the distance to their neighbours (3DGS, section 5.1).

    With them come the times (N,) at which they were seen, NaN where that is not known.

    They sit at the scene's own points, or at ``most`` of them chosen at random. Where there are
    none, or the start is "surfaces" and there are fewer than ``options.count``, others join them as
    ``options.start`` and ``options.start_around`` say: at random in the box and nearly grey, as all
    methods do on D-NeRF; where silhouettes overlap; or on surfaces. A share of them lies on what
    moves, if ``options.moving_share`` says so. Those of the run ``options.of_run`` stand in place
    of all these, as they are.

    Raises:
        DataError: that run cannot be used.
    """
    if options.of_run is not None:
        splats = of_run(Path(options.of_run), options.sh_degree)
        return splats, torch.full((len(splats),), math.nan)
    given = _given_points(scene, pictures, most, generator)
    wanted = min(options.count, most) - len(given.means)
    start = _start(scene, options)
    if not len(given.means) or (start == "surfaces" and wanted > 0):
        moving = round(options.moving_share * wanted)
        found = changing.sample_points(scene, pictures, moving, generator)
        given, left = _joined(given, found), wanted - len(found.means)
        if left:
            more = _new_points(scene, start, left, pictures, background, generator)
            given = _joined(given, more)
    means, colours, times = given
    n = len(means)
    sh = torch.zeros(n, (options.sh_degree + 1) ** 2, 3)
    sh[:, 0] = (colours - 0.5) / SH_C0
    quats = torch.zeros(n, 4)
    quats[:, 0] = 1
    splats = Splats(
        means=means,
        quats=quats,
        log_scales=_spacing(means, scene.bound).log()[:, None].repeat(1, 3),
        logit_opacities=torch.full((n,), math.log(options.opacity / (1 - options.opacity))),
        sh=sh,
    )
    return splats, times


def _joined(some: Points, others: Points) -> Points:
    return Points(*map(torch.cat, zip(some, others, strict=True)))


def of_run(folder: Path, sh_degree: int) -> Splats:
    """Return the canonical splats of a run, with harmonics of another degree: cut, or 0 beyond.

    Raises:
        DataError: the run cannot be used.
    """
    _, model, _ = open_with_model(folder)
    splats = model.canonical().splats.detach().map(torch.clone)
    wanted = (sh_degree + 1) ** 2
    sh = torch.nn.functional.pad(
        splats.sh[:, :wanted], (0, 0, 0, max(0, wanted - splats.sh.shape[1]))
    )
    return replace(splats, sh=sh.contiguous())


def _start(scene: Scene, options: SplatOptions) -> str:
    """Return where splats lie that the scene brings no points for, see ``SplatOptions.start``."""
    if options.start_around is not None and cameras_stand_around(scene):
        return options.start_around
    return options.start


def _given_points(
    scene: Scene, pictures: Pictures, most: int, generator: torch.Generator
) -> Points:
    """Return the scene's points, coloured from the pictures if the format has no colours."""
    means = torch.from_numpy(scene.points)
    chosen: slice | Tensor = slice(None)
    if len(means) > most:
        chosen = torch.randperm(len(means), generator=generator)[:most].sort().values
    if scene.colours is None:
        return at_unknown_times(means[chosen], colours_of(means[chosen], scene, pictures))
    return at_unknown_times(means[chosen], torch.from_numpy(scene.colours)[chosen])


def _new_points(
    scene: Scene,
    start: str,
    count: int,
    pictures: Pictures,
    background: Tensor,
    generator: torch.Generator,
) -> Points:
    if start == "silhouettes":
        return silhouettes.sample_points(scene, pictures, background, count, generator)
    if start == "surfaces":
        return surfaces.sample_points(scene, pictures, count, generator)
    means = (2 * torch.rand(count, 3, generator=generator) - 1) * scene.bound
    return at_unknown_times(means, 0.5 + SH_C0 * torch.rand(count, 3, generator=generator) / 255)


def _spacing(means: Tensor, bound: float) -> Tensor:
    """Return the root mean square distance of each mean to its three nearest neighbours (N,)."""
    count = min(NEIGHBOURS, len(means) - 1)
    if count < 1:
        return torch.full((len(means),), 0.1 * bound)
    squares = torch.from_numpy(mean_squares(means.double().numpy(), count))
    return squares.clamp(min=1e-7).sqrt().float()


def facts_of(scene: Scene, splats: Splats) -> Facts:
    """Return what a motion may know of the scene, which ``splats`` are about to represent."""
    return Facts(scene.bound, _box(splats.means, scene.bound), len(scene.train_times))


def _box(means: Tensor, bound: float) -> Box:
    """Return the box that holds all but the outermost of the means, and some more.

    4D-GS's code gives its grid the box of the first cloud as well. Random starts have strays,
    hence the quantiles; what ends up outside moves like the border.
    """
    means = means.double()
    lower, upper = means.quantile(STRAYS, 0), means.quantile(1 - STRAYS, 0)
    half = ((upper - lower) * (0.5 + MARGIN)).clamp(min=0.01 * bound)
    centre = (lower + upper) / 2
    return _corner(centre - half), _corner(centre + half)


def _corner(point: Tensor) -> Corner:
    x, y, z = point.tolist()
    return x, y, z
