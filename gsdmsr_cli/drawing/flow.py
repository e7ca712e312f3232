"""Draws the optical flow of moving splats: how far what a pixel shows moves between two times."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from gsdmsr_cli.gaussians.moment import Moment
from gsdmsr_cli.ground.geometry import SH_C0
from gsdmsr_cli.ground.splatting_constants import ALPHA_MIN, NEAR
from gsdmsr_cli.raster import Engine
from gsdmsr_cli.scene.camera import Camera


def draw_flow(
    moment: Moment, camera: Camera, later: Moment, next_camera: Camera, engine: Engine
) -> Tensor:
    """Return the (H, W, 2) displacement x, y of what is seen under ``camera`` [px].

    Each splat's centre is projected now and later; the differences are blended with the weights
    with which the splats' colours are blended in the picture, and divided by alpha: the expected
    displacement. 0 where nothing is seen.

    Args:
        moment: N splats at this moment.
        camera: of this moment.
        later: the same N splats at the next moment.
        next_camera: of the next moment, whose pictures have the same size.
        engine: draws the displacements as if they were colours.
    """
    moved = screen_motion(moment, camera, later, next_camera)
    return blend_motion(moved, moment, camera, engine)[0]


def screen_motion(moment: Moment, camera: Camera, later: Moment, next_camera: Camera) -> Tensor:
    """Return the (N, 2) displacements of the splats' centres on the screen [px].

    Arguments as in ``draw_flow``. What goes far out of the picture goes no further than its sides.
    """
    moved = project(later.splats.means, next_camera) - project(moment.splats.means, camera)
    most = float(camera.width + camera.height)
    return torch.nan_to_num(moved).clamp(-most, most)


def blend_motion(
    moved: Tensor, moment: Moment, camera: Camera, engine: Engine
) -> tuple[Tensor, Tensor]:
    """Return the expected (H, W, 2) displacement where splats have displacements (N, 2) [px].

    And alpha (H, W), where they are drawn at all.
    """
    scale = max(float(moved.detach().abs().max()) if len(moved) else 0.0, 1e-6)
    # engines clamp colours at 0, so displacements go to [0, 1] and back: with weights w that sum
    # to alpha, sum w (d / s + 1) / 2 = (sum w d / s + alpha) / 2
    colours = moved.new_full((len(moved), 3), 0.5)
    colours[:, :2] = (moved / scale + 1) / 2
    coloured = replace(moment.splats, sh=((colours - 0.5) / SH_C0)[:, None, :])
    frame = engine.rasterize(Moment(coloured, moment.axes), camera, moved.new_zeros(3))
    alpha = frame.alpha[..., None]
    blended = scale * (2 * frame.rgb[..., :2] - alpha)
    mean = torch.where(alpha > ALPHA_MIN, blended / alpha.clamp(min=ALPHA_MIN), 0.0)
    return mean, frame.alpha


def project(means: Tensor, camera: Camera) -> Tensor:
    """Return the (N, 2) places on the screen of (N, 3) points [px].

    What lies nearer than splats are drawn is projected as if it lay there.
    """
    rotation = torch.from_numpy(camera.rotation.copy()).to(means)
    x, y, z = (means @ rotation.T + torch.from_numpy(camera.translation.copy()).to(means)).unbind(1)
    depth = z.clamp(min=NEAR)
    return torch.stack([camera.fx * x / depth + camera.cx, camera.fy * y / depth + camera.cy], 1)
