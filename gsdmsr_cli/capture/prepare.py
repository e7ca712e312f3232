"""Turns a capture into a scene folder; finished stages are kept until all are done."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gsdmsr_cli.capture import write
from gsdmsr_cli.capture.child import run_child
from gsdmsr_cli.capture.colmap import LARGEST
from gsdmsr_cli.capture.consistency import moving_share, turning_share
from gsdmsr_cli.capture.convert import write_converted
from gsdmsr_cli.capture.features import write_features
from gsdmsr_cli.capture.frames import Frames, read_frames, write_frames
from gsdmsr_cli.capture.masks import digest, require_room, write_given_masks
from gsdmsr_cli.capture.motion import write_found_masks
from gsdmsr_cli.capture.normalize import normalize
from gsdmsr_cli.capture.options import Options
from gsdmsr_cli.capture.pairs import choose_pairs
from gsdmsr_cli.capture.quality import assess
from gsdmsr_cli.capture.reconstruction import Reconstruction, read_reconstruction, with_placed
from gsdmsr_cli.capture.report import write_page
from gsdmsr_cli.capture.rig import Rig, read_rig, write_rig
from gsdmsr_cli.capture.second_masks import Standing, with_masks, write_second_masks
from gsdmsr_cli.capture.source import Source
from gsdmsr_cli.capture.stages import Stages
from gsdmsr_cli.capture.stages import digest as stage_digest
from gsdmsr_cli.capture.versions import versions
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.scene import picture_hashes
from gsdmsr_cli.scene.scene import Scene

ShowProgress = Callable[[str], AbstractContextManager[OnProgress]]
"""Called with the name of a piece of work; yields the function that its progress is reported to."""

TRUSTED = 3
"""Points that fewer frames have found do not become points to start from."""


@dataclass(frozen=True)
class Masks:
    """Masks that a user gives: a folder of pictures, white where something moves, or black."""

    folder: Path
    inverted: bool = False


@dataclass(frozen=True, eq=False)
class Cameras:
    """What has been found of the cameras.

    Attributes:
        matches: folder of COLMAP's database of the keyframes.
        of_keyframes: their cameras, and the points.
        found: cameras of all frames.
    """

    matches: Path
    of_keyframes: Reconstruction
    found: Reconstruction


def prepare(
    source: Source,
    masks: Masks | None,
    options: Options,
    stages: Stages,
    show_progress: ShowProgress,
) -> Path:
    """Return the folder of the finished scene, one of the stages' folders.

    Raises:
        DataError: the source cannot be used; the message says why.
    """
    pipeline = _Pipeline(source, options, stages, show_progress)
    frames, features = pipeline.find_frames()
    moving, masked_by = None, "nothing"
    if masks is not None:
        moving, masked_by = pipeline.take_masks(masks, frames), "given"
        turned = "drop --invert-masks" if masks.inverted else "--invert-masks takes black for it"
        require_room(moving, frames, f"is it white that moves? {turned}")
    elif options.auto_mask:
        first = pipeline.find_cameras(frames, features, None)
        moving, masked_by = pipeline.find_masks(frames, first), "found"
        require_room(
            moving, frames, "the first cameras are wrong: drop --auto-mask or give --masks"
        )
    cameras = pipeline.find_cameras(frames, features, moving)
    found = cameras.found
    require_registered(frames, found, options.min_registered)
    if moving is None and options.mark_motion and source.kind == "video":
        moving, masked_by = pipeline.find_masks(frames, cameras), "found"
    with show_progress("judging the cameras"):
        matches = cameras.matches
        shares = moving_share(matches, cameras.of_keyframes), turning_share(matches, found.lens)
        quality = assess(frames, found, *shares, masked_by, moving)
    provenance = {
        "input": {"name": source.root.name, "kind": source.kind, "sha256": pipeline.key["source"]},
        "masks": masked_by,
        "options": asdict(options),
        "versions": pipeline.key["versions"],
    }

    def make(folder: Path) -> None:
        with show_progress("writing the scene") as on_progress:
            given = frames, pipeline.rig, moving, found, options
            _write_scene(folder, *given, provenance, quality, on_progress)

    return pipeline.run("scene", make, test_every=options.test_every)


def convert(
    folder: Path, stages: Stages, show_progress: ShowProgress, standing: Standing | None = None
) -> Path:
    """Return the folder of a published data set's scene, one of the stages' folders.

    Frames of its videos that are not beside them are decoded into a stage of their own.

    Args:
        folder: of the data set.
        stages: finished ones are not done again.
        show_progress: see there.
        standing: what stands still in it, by which what moves is masked; None leaves its masks.

    Raises:
        DataError: the data set cannot be used; the message says why.
    """
    with show_progress("reading the data set") as on_progress:
        scene = read_scene(folder, on_progress, stages.root / _decoded_name(folder))
    key: dict[str, Any] = {
        "layout": scene.layout, "fingerprint": scene.fingerprint, "versions": versions(),
        "pictures": picture_hashes.digest(scene.pictures),
    }  # fmt: skip
    if standing is not None:
        key |= {"standing": standing.key}
        scene = _masked(scene, standing, stages, key, show_progress)

    def make(made: Path) -> None:
        with show_progress("writing the scene") as on_progress:
            write_converted(made, scene, on_progress)

    return stages.run("scene", key, make)


def _masked(
    scene: Scene,
    standing: Standing,
    stages: Stages,
    key: Mapping[str, Any],
    show_progress: ShowProgress,
) -> Scene:
    def find(folder: Path) -> None:
        with show_progress("finding what moves") as on_progress:
            write_second_masks(folder, scene, standing, on_progress)

    return with_masks(scene, stages.run("masks", key, find))


def _decoded_name(folder: Path) -> str:
    """Return the name of the stage for frames of a data set's videos, which ``read_scene`` fills.

    It is never finished by itself: what is in it is whole, video by video.
    """
    videos = sorted(folder.glob("*.mp4"))
    key = {"videos": picture_hashes.digest(picture_hashes.sampled(folder, videos))}
    return f"decoded-{stage_digest(key)}"


class _Pipeline:
    """The stages, each of which depends on those before it.

    ``key`` holds all that the next stage depends on.
    """

    def __init__(
        self, source: Source, options: Options, stages: Stages, show_progress: ShowProgress
    ) -> None:
        self.source, self.options, self.stages, self.show_progress = (
            source,
            options,
            stages,
            show_progress,
        )
        self.rig: Rig | None = None
        with show_progress("reading the source"):
            self.key: dict[str, Any] = {"source": source.digest(), "kind": source.kind}
        self.key["versions"] = versions()

    def run(self, name: str, make: Callable[[Path], None], **more: Any) -> Path:
        """Return the stage's folder; from now on everything depends on ``more`` as well."""
        self.key |= more
        return self.stages.run(name, self.key, make)

    def find_frames(self) -> tuple[Frames, Path]:
        """Return the frames and the folder of their features."""
        options = self.options

        def choose(folder: Path) -> None:
            with self.show_progress("choosing frames") as on_progress:
                given = folder, self.source, options.frames, options.max_side
                if self.source.kind == "rig":
                    write_rig(*given, options.offsets, on_progress)
                else:
                    write_frames(*given, on_progress)

        def find(folder: Path) -> None:
            with self.show_progress("finding features") as on_progress:
                pictures = [frames.folder / name for name in frames.names]
                write_features(folder, pictures, options.features, on_progress)

        chosen = self.run(
            "frames", choose, frames=options.frames, max_side=options.max_side,
            offsets=dict(options.offsets),
        )  # fmt: skip
        if self.source.kind == "rig":
            self.rig = read_rig(chosen)
        frames = read_frames(chosen)
        return frames, self.run("features", find, features=options.features)

    def take_masks(self, masks: Masks, frames: Frames) -> Path:
        """Return the folder of the frames' masks, from those that a user gives."""

        def take(folder: Path) -> None:
            with self.show_progress("reading masks") as on_progress:
                given = masks.folder, masks.inverted
                write_given_masks(folder, *given, self.source, frames, on_progress)

        return self.run("masks", take, masks=digest(masks.folder, masks.inverted))

    def find_masks(self, frames: Frames, by: Cameras) -> Path:
        """Return the folder of masks of what disagrees with cameras."""

        def find(folder: Path) -> None:
            with self.show_progress("finding what moves") as on_progress:
                keyframes = len(by.of_keyframes.names)
                write_found_masks(folder, frames, by.found, keyframes, on_progress)

        return self.run("masks", find, masks="found")

    def find_cameras(self, frames: Frames, features: Path, masks: Path | None) -> Cameras:
        """Return the cameras of keyframes, and of all other frames by what these have found."""
        options = self.options
        keyframes = frames if self.rig else frames.some(options.keyframes)
        self.key["keyframes"] = len(keyframes.names)
        matches, model = self._map(keyframes, features, masks)
        of_keyframes = read_reconstruction(model)
        if len(keyframes.names) == len(frames.names):
            return Cameras(matches, of_keyframes, of_keyframes)

        def place(folder: Path) -> None:
            with self.show_progress("finding cameras between") as on_progress:
                arguments = {
                    "out": str(folder), "largest": str(model / LARGEST), "names": frames.names,
                    "features": str(features), "masks": None if masks is None else str(masks),
                    "seed": options.seed,
                }  # fmt: skip
                run_child("place", arguments, on_progress)

        placed = self.run("between", place)
        return Cameras(matches, of_keyframes, with_placed(of_keyframes, placed))

    def _map(self, frames: Frames, features: Path, masks: Path | None) -> tuple[Path, Path]:
        """Return the folders of the matches of frames and of the model that is found from them."""
        options = self.options

        def match(folder: Path) -> None:
            with self.show_progress("matching frames") as on_progress:
                video = not frames.of_pictures
                arguments = {
                    "out": str(folder), "pictures": str(frames.folder), "names": frames.names,
                    "features": str(features), "masks": None if masks is None else str(masks),
                    "camera_model": options.camera_model, "focal": frames.focal,
                    "pairs": choose_pairs(len(frames.names), options.matching, video),
                    "seed": options.seed,
                }  # fmt: skip
                run_child("match", arguments, on_progress)

        def find(folder: Path) -> None:
            with self.show_progress("finding cameras") as on_progress:
                arguments = {
                    "matches": str(matches), "pictures": str(frames.folder), "out": str(folder),
                    "mapping": options.mapping, "seed": options.seed, "count": len(frames.names),
                }  # fmt: skip
                run_child("map", arguments, on_progress)

        matches = self.run(
            "matches", match, camera_model=options.camera_model, matching=options.matching,
            seed=options.seed,
        )  # fmt: skip
        return matches, self.run("model", find, mapping=options.mapping)


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
    rig: Rig | None,
    masks: Path | None,
    found: Reconstruction,
    options: Options,
    provenance: dict[str, Any],
    quality: dict[str, Any],
    on_progress: OnProgress,
) -> None:
    when = dict(zip(frames.names, frames.times, strict=True))
    every = 0 if rig else options.test_every
    views, points, bound = normalize(found, [when[n] for n in found.names], every)
    cameras = views
    if rig is not None:
        views = rig.views(views)
    if masks is not None:
        views = write.write_masks(folder, masks, views, found.lens)
    pictures = frames.folder if rig is None else rig.folder
    write.write_pictures(folder, pictures, views, found.lens, on_progress)
    write.write_transforms(folder / "transforms.json", views, write.POINTS)
    trusted = found.tracks >= (TRUSTED if rig is None else 2)
    write.write_points(folder / write.POINTS, points[trusted], found.colours[trusted])
    title = f"Cameras of {provenance['input']['name']}"
    write_page(folder / write.REPORT, title, quality, cameras, np.asarray(points[trusted]))
    duration = frames.duration if rig is None else rig.times[-1]
    write.write_note(folder / write.NOTE, bound, duration, provenance, quality)
