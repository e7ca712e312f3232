"""From a source to a scene folder: the stages in their order, each kept until all are done."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from gsdmsr_cli.capture import write
from gsdmsr_cli.capture.child import run_child
from gsdmsr_cli.capture.consistency import disagreeing_share
from gsdmsr_cli.capture.features import write_features
from gsdmsr_cli.capture.frames import Frames, read_frames, write_frames
from gsdmsr_cli.capture.options import Options
from gsdmsr_cli.capture.pairs import choose_pairs
from gsdmsr_cli.capture.quality import assess
from gsdmsr_cli.capture.reconstruction import Reconstruction, read_reconstruction
from gsdmsr_cli.capture.report import write_page
from gsdmsr_cli.capture.settle import settle
from gsdmsr_cli.capture.source import Source
from gsdmsr_cli.capture.stages import Stages
from gsdmsr_cli.errors import DataError
from gsdmsr_cli.machine import versions

Tell = Callable[[int, int], None]
Watch = Callable[[str], AbstractContextManager[Tell]]
"""Called with what begins; yields what is told of its progress."""

POINTS, REPORT = "points.ply", "report.html"

TRUSTED = 3
"""Points that fewer frames have found do not become points to start from."""


def prepare(source: Source, options: Options, stages: Stages, watch: Watch) -> Path:
    """Return the folder of the finished scene, among the stages.

    Raises:
        DataError: the source cannot be used; the message says why.
    """
    with watch("reading the source"):
        digest = source.digest()
    key: dict[str, Any] = {
        "source": digest, "kind": source.kind, "frames": options.frames,
        "max_side": options.max_side, "version": versions()["gsdmsr"],
    }  # fmt: skip

    def make_frames(folder: Path) -> None:
        with watch("choosing frames") as tell:
            write_frames(folder, source, options.frames, options.max_side, tell)

    frames = read_frames(stages.run("frames", key, make_frames))
    key |= {"features": options.features}

    def make_features(folder: Path) -> None:
        with watch("finding features") as tell:
            pictures = [frames.folder / name for name in frames.names]
            write_features(folder, pictures, options.features, tell)

    features = stages.run("features", key, make_features)
    key |= {
        "camera_model": options.camera_model,
        "matching": options.matching,
        "seed": options.seed,
    }

    def make_matches(folder: Path) -> None:
        with watch("matching frames") as tell:
            pairs = choose_pairs(len(frames.names), options.matching, source.kind == "video")
            arguments = {
                "out": str(folder), "pictures": str(frames.folder), "names": frames.names,
                "features": str(features), "camera_model": options.camera_model,
                "focal": frames.focal, "pairs": pairs, "seed": options.seed,
            }  # fmt: skip
            run_child("match", arguments, tell)

    matches = stages.run("matches", key, make_matches)
    key |= {"mapping": options.mapping}

    def make_model(folder: Path) -> None:
        with watch("finding cameras") as tell:
            arguments = {
                "matches": str(matches), "pictures": str(frames.folder), "out": str(folder),
                "mapping": options.mapping, "seed": options.seed, "count": len(frames.names),
            }  # fmt: skip
            run_child("map", arguments, tell)

    found = read_reconstruction(stages.run("model", key, make_model))
    require_registered(frames, found, options.min_registered)
    quality = assess(frames, found, disagreeing_share(matches, found))
    provenance = {
        "input": {"name": source.root.name, "kind": source.kind, "sha256": digest},
        "options": asdict(options),
        "versions": versions(),
    }

    def make_scene(folder: Path) -> None:
        with watch("writing the scene") as tell:
            _write_scene(folder, frames, found, options, provenance, quality, tell)

    return stages.run("scene", key | {"test_every": options.test_every}, make_scene)


def require_registered(frames: Frames, found: Reconstruction, least: float) -> None:
    """Raise DataError if fewer than this share of the frames have a camera in one world."""
    share = len(found.names) / len(frames.names)
    if share >= least:
        return
    parts = [len(part) for part in found.parts]
    apart = (
        f"; they fall into {len(parts)} parts that nothing connects, of "
        f"{', '.join(map(str, parts))} frames" if len(parts) > 1 else ""
    )  # fmt: skip
    raise DataError(
        f"only {len(found.names)} of {len(frames.names)} frames have a camera in one world{apart}: "
        "try --matching exhaustive, film without cuts and more slowly, or allow it with "
        f"--min-registered {share:.2f}"
    )


def _write_scene(
    folder: Path,
    frames: Frames,
    found: Reconstruction,
    options: Options,
    provenance: dict[str, Any],
    quality: dict[str, Any],
    tell: Tell,
) -> None:
    when = dict(zip(frames.names, frames.times, strict=True))
    views, points, bound = settle(found, [when[n] for n in found.names], options.test_every)
    write.write_pictures(folder, frames.folder, views, found.lens, tell)
    write.write_transforms(folder / "transforms.json", views, POINTS)
    trusted = found.tracks >= TRUSTED
    write.write_points(folder / POINTS, points[trusted], found.colours[trusted])
    title = f"Cameras of {provenance['input']['name']}"
    write_page(folder / REPORT, title, quality, views, np.asarray(points[trusted]))
    write.write_note(folder / write.NOTE, bound, frames.duration, provenance, quality)


def publish(scene: Path, out: Path) -> None:
    """Move a finished scene to ``out``, in place of an earlier one."""
    out.parent.mkdir(parents=True, exist_ok=True)
    if out.exists():
        earlier = out.with_name(f".{out.name}.earlier")
        shutil.rmtree(earlier, ignore_errors=True)
        out.rename(earlier)
        scene.rename(out)
        shutil.rmtree(earlier)
    else:
        scene.rename(out)
