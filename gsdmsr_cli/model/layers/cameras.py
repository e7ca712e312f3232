"""Cameras that are refined in training: a small rigid correction of each picture's camera, and if
asked for one factor on their focal length.

A camera is turned about its own place by the rotation vector w and shifted by t, both in world
axes: x_camera = R exp(-[w]) (x - c - t) where the scene has R (x - c). That is what turning and
shifting all splats the other way does to the picture, so the gradients by w and t follow from those
by the splats (``gaussians.torque``), exactly, whatever the engine.

What all cameras could do together is left to the splats: the mean of the corrections is taken away,
and so is the part of the shifts that scales the path about its middle. Not so the focal length,
which scaling the world cannot stand for.

A focal length s times as long shows what dividing all depths by s would: m - c becomes
(1 + (1 / s - 1) d d^T) (m - c) with d along the line of sight, and axes likewise, while colours
stay those of the direction from which the splat is seen.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.autograd import Function
from torch.autograd.function import once_differentiable

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.gaussians.splats import Splats
from gsdmsr_cli.gaussians.torque import stretch, torque
from gsdmsr_cli.ground.geometry import scaled_axes
from gsdmsr_cli.model.layer import Facts, Instant
from gsdmsr_cli.model.layers._views import PerView
from gsdmsr_cli.model.parameter import Parameter
from gsdmsr_cli.model.view_rows import Per
from gsdmsr_cli.options.strict import require, require_progress, require_rates
from gsdmsr_cli.scene.camera import Camera

Vector = NDArray[np.float64]


@dataclass(frozen=True)
class Options:
    """Settings.

    Attributes:
        per: what has a correction: each "frame", each fixed "camera", or "auto": cameras where a
            rig has at least two fixed ones with two pictures or more each, else frames.
        rate: learning rate of turns [rad] and shifts [scene bounds] at the start and the end.
        weight: of the mean over the corrections of their squared numbers, which holds them to 0.
        since: progress from which they are learnt, once the static phase is over.
        focal: whether the focal length is learnt too: one factor for all pictures, or of each fixed
            camera, which nothing holds to 1.
        focal_rate: learning rate of its logarithm at the start and the end.
    """

    per: Per = "auto"
    rate: tuple[float, float] = (1e-4, 1e-5)
    weight: float = 0.1
    since: float = 0.05
    focal: bool = False
    focal_rate: tuple[float, float] = (3e-3, 3e-4)

    def __post_init__(self) -> None:
        require(self, "weight", self.weight >= 0, "0 or more")
        require_progress(self, "since")
        require_rates(self, "rate")
        require_rates(self, "focal_rate")


class Cameras(PerView):
    """Rows (6,): a rotation vector [rad] and a shift [scene bounds], in world axes.

    Errors of single poses differ from one picture to the next, so those of a view that was not
    trained on are taken from several neighbours, of which they are the smooth part.

    Attributes:
        log_focals: logarithms of factors on the focal length: (1,), or (rows,) of fixed cameras;
            None if the focal length stays as it is.
    """

    beside = 6

    def __init__(
        self,
        per: Per,
        rate: tuple[float, float],
        weight: float,
        since: float,
        bound: float,
        focal_rate: tuple[float, float] | None,
    ) -> None:
        self.log_focals, more = None, []
        if focal_rate is not None:
            self.log_focals = torch.zeros(1)
            more.append(Parameter("log_focals", self.log_focals, rate=focal_rate))
        super().__init__(per, (6,), rate, weight, since, bound, more)

    def begin_with(self, views: Sequence[tuple[Camera, float]]) -> None:
        """Hold no correction for each view, or each fixed camera."""
        super().begin_with(views)
        if self.log_focals is not None and self.rows.per_camera:
            self.parameters()[-1].set_values(self.log_focals.new_zeros(self.rows.count))

    def place(self, camera: Camera, time: float) -> Camera:
        """Return the camera with its correction, the very same where there is none."""
        own = self.weighed(self.corrections(), camera, time)
        if own is None:
            return camera
        log_focal = self._log_focal(camera, time)
        factor = 1.0 if log_focal is None else math.exp(float(log_focal.detach()))
        placed = corrected(camera, own.numpy())
        return replace(placed, fx=factor * placed.fx, fy=factor * placed.fy)

    def _log_focal(self, camera: Camera, time: float) -> Tensor | None:
        """Return the logarithm () of the factor on a view's focal length, None if it has none."""
        if self.log_focals is None:
            return None
        if self.rows.per_camera:
            return self.weighed(self.log_focals, camera, time)
        return self.log_focals[0] if self.rows.weights(camera, time) else None

    @torch.no_grad()
    def corrections(self) -> Tensor:
        """Return the corrections as they are applied, (rows, 6) float64 [rad, world units]."""
        values = self.values.detach().cpu().double()
        values = values - values.mean(dim=0)
        centres = torch.from_numpy(self.rows.centres())
        arms = centres - centres.mean(dim=0)
        turns, shifts = values[:, :3], self.bound * values[:, 3:]
        squares = arms.square().sum()
        if squares > 0:
            shifts = shifts - (shifts * arms).sum() / squares * arms
        return torch.cat([turns, shifts], dim=1)

    def as_seen(self, moment: Moment, instant: Instant) -> Moment:
        """Return the moment as it is, whose gradients reach the correction of the view as well.

        If the focal length is learnt it has axes, since what a focal length does to a splat no
        rotation and scale does.
        """
        if not self.learning or not torch.is_grad_enabled() or instant.view is None:
            return moment
        view, time = instant.view, instant.time
        own, log_focal = self.weighed(self.values, view, time), self._log_focal(view, time)
        if own is None:
            return moment
        applied = self.weighed(self.corrections(), view, time)
        assert applied is not None
        camera = corrected(view, applied.numpy())
        placed = _Placed(
            applied[:3],
            torch.from_numpy(camera.centre),
            torch.from_numpy(camera.rotation[2]),
            self.bound,
        )
        splats, axes = moment.splats, moment.axes
        if log_focal is not None and axes is None:
            axes = scaled_axes(splats.quats, splats.log_scales)
        means, quats, sh, axes = _Seen.apply(
            own, log_focal, placed, splats.means, splats.quats, splats.sh, axes
        )
        return replace(moment, splats=replace(splats, means=means, quats=quats, sh=sh), axes=axes)

    def tell_views(self, views: Sequence[tuple[Camera, float]]) -> dict[str, Any]:
        """Return how views are drawn, of which kinds how many there are."""
        about = (
            "cameras with a correction learnt from the train pictures; other views have the smooth "
            "part of those of train views beside them on their path, or none"
        )
        told = {"about": about, **super().tell_views(views)}
        if self.log_focals is not None:
            told["focal_factors"] = self.log_focals.detach().double().exp().tolist()
        return told

    def check(self) -> None:
        """Raise ValueError unless there is a correction for every view."""
        if self.values.shape[1:] != (6,):
            raise ValueError(f"corrections of cameras of shape {tuple(self.values.shape)}")
        super().check()
        wanted = (len(self.values) if self.rows.per_camera else 1,)
        if self.log_focals is not None and tuple(self.log_focals.shape) != wanted:
            raise ValueError(
                f"factors on focal lengths of shape {tuple(self.log_focals.shape)}, not {wanted}"
            )


@dataclass(frozen=True, eq=False)
class _Placed:
    """A view's camera as it is corrected.

    Attributes:
        turn: (3,) rotation vector that was applied [rad].
        centre: (3,) where it is [world units].
        ahead: (3,) unit vector along its line of sight.
        bound: of the scene [world units].
    """

    turn: Tensor
    centre: Tensor
    ahead: Tensor
    bound: float


class _Seen(Function):
    """Splats as they are; backward, what their gradients say of a camera."""

    @staticmethod
    def forward(
        ctx: Any,
        own: Tensor,  # (6,), which gets the gradient
        log_focal: Tensor | None,  # (), likewise
        placed: _Placed,
        means: Tensor,
        quats: Tensor,
        sh: Tensor,
        axes: Tensor | None,
    ) -> tuple[Tensor | None, ...]:
        ctx.save_for_backward(means, quats, sh, axes)
        ctx.placed, ctx.own = placed, own.detach()
        ctx.log_focal = None if log_focal is None else log_focal.detach()
        ctx.set_materialize_grads(False)
        seen = (means.view_as(means), quats.view_as(quats), sh.view_as(sh))
        return *seen, None if axes is None else axes.view_as(axes)

    @staticmethod
    @once_differentiable  # type: ignore[untyped-decorator]
    def backward(
        ctx: Any,
        d_means: Tensor | None,
        d_quats: Tensor | None,
        d_sh: Tensor | None,
        d_axes: Tensor | None,
    ) -> tuple[Tensor | None, ...]:
        means, quats, sh, axes = ctx.saved_tensors
        placed: _Placed = ctx.placed
        given = means, quats, axes, sh, d_means, d_quats, d_axes, d_sh
        turned = torque(*given, placed.centre).cpu()
        shifted = turned.new_zeros(3)
        if d_means is not None:
            shifted = d_means.sum(dim=0, dtype=torch.float64).cpu()
        # a turn by w + d is one by w, then one by J d (``left_jacobian``), here of the world back
        d_turn = -left_jacobian(placed.turn).mT @ turned
        found = torch.cat([d_turn, -placed.bound * shifted]).to(ctx.own)
        d_log_focal = None
        if ctx.log_focal is not None:
            at = placed.centre, placed.ahead
            d_log_focal = -stretch(means, axes, sh, d_means, d_axes, d_sh, *at).to(ctx.log_focal)
        return found, d_log_focal, None, d_means, d_quats, d_sh, d_axes


def corrected(camera: Camera, correction: Vector) -> Camera:
    """Return a camera turned about its place and shifted, by (6,) [rad, world units]."""
    turn = torch.linalg.matrix_exp(_cross(torch.from_numpy(correction[:3]))).numpy()
    pose = np.eye(4)
    pose[:3, :3] = camera.rotation @ turn.T
    pose[:3, 3] = -pose[:3, :3] @ (camera.centre + correction[3:])
    return replace(camera, world_to_camera=pose)


def left_jacobian(turn: Tensor) -> Tensor:
    """Return J (3, 3) with exp([w + d]) = exp([J d]) exp([w]) to first order, of w (3,) [rad].

    The series of Barfoot, State Estimation for Robotics (2017), (7.77), up to the fourth power.
    """
    cross = _cross(turn)
    total = term = torch.eye(3, dtype=turn.dtype)
    for power in range(2, 6):
        term = term @ cross / power
        total = total + term
    return total


def _cross(vector: Tensor) -> Tensor:
    """Return the matrix (3, 3) of the vector product with (3,) from the left."""
    x, y, z = vector.tolist()
    return vector.new_tensor([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def start(options: Options, facts: Facts, splats: Splats, generator: torch.Generator) -> Cameras:
    """Return corrections that change nothing until they have been trained."""
    o = options
    focal_rate = o.focal_rate if o.focal else None
    return Cameras(o.per, o.rate, o.weight, o.since, facts.bound, focal_rate)
