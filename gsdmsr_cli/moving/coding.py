"""What has been baked, as tables of integers, as coarse as steps say; ``decoding`` reads them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.moving.baked import COLOURS, OF_BODIES, Baked, Bodies
from gsdmsr_cli.moving.curves import Track
from gsdmsr_cli.moving.parts import Floats, Table, plain_table, short, signed_table
from gsdmsr_cli.moving.places import code_places

Steps = Mapping[str, float]
"""How coarse each part is: the difference of two values that can be told apart, by its name. Those
of tracks are of their channels; those of places are in units of the bound, near the origin."""

FIXED = {"points": 2.0**-14, "log_radii": 2.0**-7, "times": 2.0**-12, "log_durations": 2.0**-6}
"""Steps of what takes few bytes; ``points`` in units of the bound."""

FINER = 0.25
"""Rounding curves adds this much of what rounding shares does."""

CURVES, SHARES = "curves/", "shares/"

TO_YCOCG = np.array([[0.25, 0.5, 0.25], [0.5, 0.0, -0.5], [-0.25, 0.5, -0.25]])


def steps_named(baked: Baked) -> dict[str, float]:
    """Return the steps of all parts whose coarseness matters, as fine as anybody can see.

    What they are in relation to one another is for the search (``moving.choosing``) to find.
    """
    names = {"means": 2.0**-13, "quats": 2.0**-7, "log_scales": 2.0**-5, "opacities": 2.0**-7}
    names |= {"sh_0": 2.0**-6}
    if baked.splats.sh_degree:
        names["sh_rest"] = 2.0**-6
    of_tracks = {"offset": 2.0**-11, "turn": 2.0**-8, "growth": 2.0**-6, "opacity": 2.0**-7}
    of_tracks |= {"sh": 2.0**-6}
    return names | {name: of_tracks[name.partition("/")[2]] for name in baked.tracks}


def coded(baked: Baked, steps: Steps, bound: float) -> list[Table]:
    """Return what the parts of a file say, the splats in an order that takes few bytes.

    Args:
        baked: what is coded.
        steps: of all that ``steps_named`` names.
        bound: half edge of the cube that holds the scene [world units].
    """
    means = _array(baked.splats.means)
    places, rows = code_places(means, baked.moving, steps["means"], bound)
    order = torch.from_numpy(rows)
    splats, first = baked.splats.take(order), order[: baked.moving]
    tables = [places, *_splat_tables(splats, steps)]
    if baked.lives is not None:
        times, durations = _array(baked.lives[first]).clip(-64, 64), FIXED["log_durations"]
        fixed = np.array([FIXED["times"]] * 2 + [durations] * 2)
        tables.append(plain_table("lives", times, fixed))
    if baked.bodies is not None:
        tables += _bodies_tables(baked.bodies, first, bound)
    for name, track in baked.tracks.items():
        held = track if name in OF_BODIES else replace(track, shares=track.shares[first])
        scale = bound if name.endswith("/offset") else 1.0
        tables += _track_tables(name, held, steps[name] * scale)
    return tables


def _splat_tables(splats: Splats, steps: Steps) -> list[Table]:
    colours = _array(splats.sh) @ TO_YCOCG.T
    values = {
        "quats": _array(splats.quats)[:, 1:],
        "log_scales": _array(splats.log_scales),
        "opacities": _array(splats.logit_opacities.sigmoid())[:, None],
        "sh_0": colours[:, 0],
        "sh_rest": colours[:, 1:].reshape(len(colours), -1),
    }
    return [plain_table(name, values[name], steps[name]) for name in values if name in steps]


def _bodies_tables(bodies: Bodies, first: Tensor, bound: float) -> list[Table]:
    tables = [plain_table("points", _array(bodies.points), FIXED["points"] * bound)]
    if bodies.log_radii is not None and bodies.body is None:
        radii = _array(bodies.log_radii)[:, None]
        tables.append(plain_table("log_radii", radii, FIXED["log_radii"]))
    if bodies.body is not None:
        tables.append(plain_table("body", _array(bodies.body[first])[:, None], 1.0))
    return tables


def _track_tables(name: str, track: Track, step: float) -> list[Table]:
    """Code a track's shares, and the curves of which any channel has a share left."""
    step = float(short(np.array([step]))[0])
    shares = _array(track.shares)
    if name == COLOURS:
        shares = in_other_colours(shares, TO_YCOCG)
    # curves are of unit length: their values at a time are that much less
    q = np.rint(shares / (step * np.sqrt(len(track.curves)))).astype(np.int64)
    left = np.flatnonzero(q.any(axis=(0, 1)))
    if not len(left):
        return []
    q = q[:, :, left]
    curves = _array(track.curves)[:, left] * np.sqrt(len(track.curves))
    # what rounding a curve adds to a channel is in proportion to the channel's share of it
    shared = np.sqrt(np.square(q, dtype=np.float64).mean(axis=(0, 1)))
    fine = FINER / np.maximum(shared, FINER)
    return [
        plain_table(CURVES + name, curves, fine),
        signed_table(SHARES + name, q.reshape(len(q), -1), step),
    ]


def in_other_colours(shares: Floats, matrix: Floats) -> Floats:
    """Return shares (M, 3 K, R) with every three channels in other colours."""
    colours = shares.reshape(len(shares), -1, 3, shares.shape[2])
    turned: Floats = np.einsum("ij,nkjr->nkir", matrix, colours)
    return turned.reshape(shares.shape)


def described(baked: Baked) -> dict[str, Any]:
    """Return what the header of a file says of the parts as a whole."""
    bodies = baked.bodies
    about = None
    if bodies is not None:
        about = {"count": len(bodies.points), "neighbours": bodies.neighbours}
    return {
        "splats": len(baked.splats),
        "moving": baked.moving,
        "sh_degree": baked.splats.sh_degree,
        "times": baked.times,
        "bodies": about,
    }


def _array(tensor: Tensor) -> Floats:
    return tensor.detach().double().numpy()
