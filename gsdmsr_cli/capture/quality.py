"""Measures how good the cameras are, and warns with advice where they are doubtful."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gsdmsr_cli.capture.frames import Frames
from gsdmsr_cli.capture.masks import NOTE, read_mask
from gsdmsr_cli.capture.reconstruction import Reconstruction
from gsdmsr_cli.ground.files import read_json

Floats = NDArray[np.float64]

REGISTERED, ERROR, TRACK, PARALLAX, OBSERVATIONS = 0.95, 1.0, 3.5, 3.0, 100
"""Share of the frames, reprojection error [px], frames a point is found in, median parallax
[degrees] and points in the poorest frame beyond which there is a warning."""

FIELD_OF_VIEW = 25.0, 110.0
"""Of the longer side, as cameras that people film with have them [degrees]."""

FOCAL_RATIO = 1.15
"""Of the focal length that was found and the one that the camera has noted, either way round."""

COVERED = 0.6
"""Share of the pictures that masks may cover without a warning."""

DISTORTION = 0.03
"""How far a lens may move the corner without a warning, as a share of the picture's diagonal."""

MOVING = 0.1
"""Share of the matches that agree with no standing point beyond which something large moves."""

TURNING = 0.8
"""Share of the matches that a rotation alone explains, beyond which cameras may be made up."""


def assess(
    frames: Frames,
    found: Reconstruction,
    moving: float,
    turning: float,
    masked_by: str,
    masks: Path | None,
) -> dict[str, Any]:
    """Return the report, fit for JSON.

    Args:
        frames: all that were chosen.
        found: the cameras that were found for them.
        moving: share of matches that disagree with the cameras.
        turning: share of matches that a camera explains that only turns.
        masked_by: where masks come from: "given", "found" or "nothing".
        masks: folder of the frames' masks.
    """
    parallax = parallaxes(found)
    width, height = found.lens.width, found.lens.height
    longer = max(width, height)
    report: dict[str, Any] = {
        "frames": {
            "chosen": len(frames.names),
            "registered": len(found.names),
            "dropped": _dropped(frames, found),
            "parts": [len(part) for part in found.parts],
            "left_out_as_blurred": len(frames.blurred),
            "left_out_as_plain": frames.plain,
            "high_range": [{"file": file, "kind": kind} for file, kind in frames.high_range],
            "cuts": [{"file": file, "seconds": seconds} for file, seconds in frames.cuts],
        },
        "reprojection_px": found.mean_error,
        "points": len(found.points),
        "track_length": float(found.tracks.mean()),
        "fewest_points_in_a_frame": min(len(seen) for seen in found.seen),
        "focal": {
            "px": found.lens.fx,
            "field_of_view_deg": math.degrees(2 * math.atan(longer / 2 / found.lens.fx)),
            "noted_px": frames.focal,
        },
        "corner_distortion_px": _corner_distortion(found),
        "diagonal_px": math.hypot(width, height),
        "parallax_deg": float(np.median(parallax)) if len(parallax) else 0.0,
        "path_over_depth": _path_over_depth(found),
        "moving_matches": moving,
        "turning_matches": turning,
        "masks": _mask_report(frames, masked_by, masks),
    }
    report["warnings"] = [*frames.doubts, *warnings(report)]
    return report


def _mask_report(frames: Frames, masked_by: str, masks: Path | None) -> dict[str, Any]:
    if masks is None:
        return {"from": masked_by, "covered": 0.0, "most_covered": 0.0, "frames_without": []}
    shares = [float(read_mask(masks / name).mean()) for name in frames.names]
    return {
        "from": masked_by,
        "covered": float(np.mean(shares)),
        "most_covered": max(shares),
        "frames_without": read_json(masks / NOTE)["missing"],
    }


def _dropped(frames: Frames, found: Reconstruction) -> list[str]:
    """Return what the frames without a camera were: file, and number where it is a video's."""
    registered = set(found.names)
    return [
        frame.file if frames.of_pictures else f"{frame.file} frame {frame.index}"
        for name, frame in zip(frames.names, frames.taken, strict=True)
        if name not in registered
    ]


def parallaxes(found: Reconstruction) -> Floats:
    """Return the largest angle [degrees] under which each point is seen from two cameras, (P,).

    Of the first and last camera that see it and one half-way: all pairs would add little.
    """
    seen_by: list[list[int]] = [[] for _ in range(len(found.points))]
    for camera, points in enumerate(found.seen):
        for point in points:
            seen_by[point].append(camera)
    centres = found.centres
    ends = np.array([(s[0], s[len(s) // 2], s[-1]) if s else (0, 0, 0) for s in seen_by], int)
    rays = centres[ends.reshape(-1, 3)] - found.points[:, None]
    rays = rays / np.maximum(np.linalg.norm(rays, axis=2, keepdims=True), 1e-12)
    pairs = [np.sum(rays[:, a] * rays[:, b], axis=1) for a, b in ((0, 1), (0, 2), (1, 2))]
    cosines = np.min(pairs, axis=0).clip(-1, 1)
    return np.asarray(np.degrees(np.arccos(cosines)), dtype=np.float64)


def _path_over_depth(found: Reconstruction) -> float:
    """Return the largest distance between cameras over the median depth of what they see."""
    centres = found.centres
    depths = [
        (found.points[seen] @ pose[2, :3] + pose[2, 3])
        for seen, pose in zip(found.seen, found.poses, strict=True)
    ]
    extent = float(np.linalg.norm(centres - centres[0], axis=1).max())
    return extent / max(float(np.median(np.concatenate(depths))), 1e-12)


def _corner_distortion(found: Reconstruction) -> float:
    """Return how far the lens moves the picture's corner from where a pinhole has it [px]."""
    lens = found.lens
    x, y = (
        np.array([(lens.width - lens.cx) / lens.fx]),
        np.array([(lens.height - lens.cy) / lens.fy]),
    )
    u, v = lens.project(x, y)
    return float(np.hypot(u - lens.width, v - lens.height)[0])


def warnings(report: Mapping[str, Any]) -> list[str]:
    """Return what is doubtful about a report's numbers, each with what to do."""
    frames, focal = report["frames"], report["focal"]
    found: list[str] = []
    if frames["registered"] < REGISTERED * frames["chosen"]:
        found.append(
            f"{len(frames['dropped'])} of {frames['chosen']} frames have no camera and are left "
            "out: try --matching both, more --frames, or film those parts more slowly"
        )
    if frames["cuts"]:
        told = ", ".join(f"{cut['file']} at {cut['seconds']:.2f} s" for cut in frames["cuts"][:5])
        more = ", ..." if len(frames["cuts"]) > 5 else ""
        found.append(
            f"the video has been cut ({told}{more}) and only its longest shot is taken: to take "
            "another, give that part as a video of its own"
        )
    if frames["left_out_as_plain"]:
        found.append(
            f"{frames['left_out_as_plain']} pictures are black or of one colour and are left out"
        )
    for video in frames["high_range"]:
        found.append(
            f"{video['file']} is HDR ({video['kind']}): its colours are taken as they are stored, "
            "so pictures look flat and pale; convert it to SDR first"
        )
    if frames["left_out_as_blurred"]:
        found.append(
            f"{frames['left_out_as_blurred']} frames are far less sharp than their neighbours and "
            "are left out: move the camera more slowly, or film in more light"
        )
    if report["reprojection_px"] > ERROR:
        found.append(
            f"points are {report['reprojection_px']:.2f} px off where they should be seen, more "
            f"than {ERROR:g}: try --camera-model OPENCV, and masks for what moves"
        )
    if report["moving_matches"] > MOVING:
        found.append(
            f"{100 * report['moving_matches']:.0f} % of what was found in two frames moves, as far "
            "as the cameras tell: something large does, or the cameras are wrong; give --masks of "
            "it, or try --auto-mask"
        )
    if report["turning_matches"] > TURNING:
        found.append(
            f"a camera that only turns explains {100 * report['turning_matches']:.0f} % of what "
            "was found in two frames: depth, path and focal length may be made up, however small "
            "the errors are; film again while walking round the scene"
        )
    if report["corner_distortion_px"] > DISTORTION * report["diagonal_px"]:
        found.append(
            f"the lens bends the corner by {report['corner_distortion_px']:.0f} px, more than "
            "cameras do: unless it is a fisheye (--camera-model OPENCV_FISHEYE), something large "
            "moves and the cameras are wrong; give --masks of it, or try --auto-mask"
        )
    if report["parallax_deg"] < PARALLAX:
        found.append(
            f"points are seen from directions only {report['parallax_deg']:.1f} degrees apart: one "
            "camera that hardly moves: expect depth to be a guess and new views to hold only near "
            "the path; film again while walking round the scene"
        )
    if report["track_length"] < min(TRACK, frames["registered"] / 2):
        found.append(
            f"points are found in only {report['track_length']:.1f} frames on average: take more "
            "--frames, or film more slowly"
        )
    if report["fewest_points_in_a_frame"] < OBSERVATIONS:
        found.append(
            f"a frame sees only {report['fewest_points_in_a_frame']} of the points: its camera may "
            "be off; keep something with texture in the picture"
        )
    return found + _mask_warnings(report["masks"]) + _focal_warnings(focal)


def _mask_warnings(masks: Mapping[str, Any]) -> list[str]:
    found = []
    if masks["frames_without"]:
        found.append(
            f"{len(masks['frames_without'])} frames have no mask, such as "
            f"{masks['frames_without'][0]}: there nothing is taken to move"
        )
    if masks["covered"] > COVERED:
        found.append(
            f"masks cover {100 * masks['covered']:.0f} % of the pictures: little is left to find "
            "cameras from; is white what moves? --invert-masks takes black for it"
        )
    return found


def _focal_warnings(focal: Mapping[str, Any]) -> list[str]:
    low, high = FIELD_OF_VIEW
    angle, noted = focal["field_of_view_deg"], focal["noted_px"]
    found = []
    if not low <= angle <= high:
        found.append(
            f"the field of view comes out as {angle:.0f} degrees, which few cameras have: the "
            "focal length is likely wrong; move sideways rather than straight ahead, and in "
            "more than one direction"
        )
    if noted is not None and not 1 / FOCAL_RATIO <= focal["px"] / noted <= FOCAL_RATIO:
        found.append(
            f"the focal length comes out as {focal['px']:.0f} px, but the camera has noted "
            f"{noted:.0f}: was the film cropped, stabilised or zoomed? check it"
        )
    return found
