"""Matches features between frames and finds cameras with COLMAP, in a process of its own.

Everything is deterministic, whatever the number of cores: frames are numbered before anything is
written about them, and each pair's sampling starts from the seed. No process has more than one
thread for it: sums of mapping depend on their order, and matching calls a BLAS that is built
without locks: two of its threads may be given the same memory, and then a few matches differ. So
the pairs are shared out among processes.
"""

from __future__ import annotations

import shutil
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

from gsdmsr_cli.capture.between import place_between
from gsdmsr_cli.capture.child import REFUSED, receive_arguments, run_child
from gsdmsr_cli.capture.failure import why_no_model
from gsdmsr_cli.capture.masks import standing_features
from gsdmsr_cli.ground.errors import DataError, GsdmsrError
from gsdmsr_cli.ground.files import write_json
from gsdmsr_cli.ground.limits import cores
from gsdmsr_cli.scene.native import load_pycolmap

PAIRS_AT_ONCE = 40
"""Pairs that are matched between two reports of the progress, and the least for a process."""

DATABASE = "database.db"
LARGEST = "largest"
PARTS = "parts.json"


def match(
    out: str,
    pictures: str,
    names: Sequence[str],
    features: str,
    masks: str | None,
    camera_model: str,
    focal: float | None,
    pairs: Sequence[tuple[int, int]],
    seed: int,
) -> None:
    """Write a database of the frames' features and of their verified matches to ``out``.

    Args:
        out: folder to write.
        pictures: folder of the frames.
        names: of the frames' files, in the order of time.
        features: folder of their features.
        masks: folder of their masks; features on what moves are left out.
        camera_model: COLMAP's name of the lens that all share.
        focal: focal length that the camera has noted [px], or None.
        pairs: indices of the frames to compare.
        seed: of the sampling.
    """
    colmap = load_pycolmap()
    database = Path(out) / DATABASE
    reader = colmap.ImageReaderOptions(camera_model=camera_model)
    colmap.Database.open(database).close()
    colmap.import_images(
        database, pictures, camera_mode=colmap.CameraMode.SINGLE,
        image_names=list(names), options=reader,
    )  # fmt: skip
    _write_features(colmap, database, features, masks, focal)
    for part in _match_apart(Path(out), [(names[i], names[j]) for i, j in pairs], seed):
        _gather(colmap, database, part / DATABASE)
        shutil.rmtree(part)


def _match_apart(out: Path, pairs: Sequence[tuple[str, str]], seed: int) -> list[Path]:
    """Match pairs of names, a share in each process; return the folders of their databases."""
    processes = max(1, min(cores(), len(pairs) // PAIRS_AT_ONCE))
    cuts = [len(pairs) * k // processes for k in range(processes + 1)]
    done = [0] * processes
    printing = threading.Lock()

    def work(index: int) -> Path:
        def on_progress(count: int, _: int) -> None:
            with printing:
                done[index] = count
                _print_progress(sum(done), len(pairs))

        part = out / f"part{index}"
        part.mkdir()
        shutil.copy(out / DATABASE, part)
        share = pairs[cuts[index] : cuts[index + 1]]
        run_child("match_share", {"out": str(part), "pairs": share, "seed": seed}, on_progress)
        return part

    with ThreadPoolExecutor(processes) as pool:
        return list(pool.map(work, range(processes)))


def match_share(out: str, pairs: Sequence[tuple[str, str]], seed: int) -> None:
    """Add the matches of pairs of names to the database in ``out``, which has their features."""
    colmap = load_pycolmap()
    verification = colmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    for begin in range(0, len(pairs), PAIRS_AT_ONCE):
        chosen = pairs[begin : begin + PAIRS_AT_ONCE]
        listing = Path(out) / "pairs.txt"
        listing.write_text("".join(f"{first} {second}\n" for first, second in chosen))
        colmap.match_image_pairs(
            Path(out) / DATABASE,
            matching_options=colmap.FeatureMatchingOptions(num_threads=1),
            pairing_options=colmap.ImportedPairingOptions(match_list_path=listing),
            verification_options=verification,
            device=colmap.Device.cpu,
        )
        _print_progress(begin + len(chosen), len(pairs))


def _gather(colmap: Any, database: Path, part: Path) -> None:
    """Write to a database what another has found of the same frames."""
    with colmap.Database.open(database) as opened, colmap.Database.open(part) as found:
        for pair, matches in zip(*found.read_all_matches(), strict=True):
            opened.write_matches(*colmap.pair_id_to_image_pair(pair), matches)
        for pair, geometry in zip(*found.read_two_view_geometries(), strict=True):
            opened.write_two_view_geometry(*colmap.pair_id_to_image_pair(pair), geometry)


def _write_features(
    colmap: Any, database: Path, folder: str, masks: str | None, focal: float | None
) -> None:
    with colmap.Database.open(database) as opened:
        for image in opened.read_all_images():
            where = Path(folder), None if masks is None else Path(masks)
            found = standing_features(*where, image.name)
            kind = colmap.FeatureExtractorType.SIFT
            described = colmap.FeatureDescriptors(type=kind, data=found.descriptors)
            opened.write_keypoints(image.image_id, found.pixels)
            opened.write_descriptors(image.image_id, described)
        if focal is not None:
            (camera,) = opened.read_all_cameras()
            for index in camera.focal_length_idxs():
                camera.params[index] = focal
            camera.has_prior_focal_length = True
            opened.update_camera(camera)


def map_frames(matches: str, pictures: str, out: str, mapping: str, seed: int, count: int) -> None:
    """Find cameras and points; write the largest model, and the frames in each, to ``out``.

    Args:
        matches: folder of the database.
        pictures: folder of the frames.
        out: folder to write.
        mapping: "incremental" or "global".
        seed: of random choices.
        count: number of frames.

    Raises:
        DataError: no two frames give a model to begin with.
    """
    colmap = load_pycolmap()
    database = Path(matches) / DATABASE
    models = Path(out) / "models"
    models.mkdir()
    if mapping == "global":
        options = colmap.GlobalPipelineOptions(num_threads=1, random_seed=seed)
        found = colmap.global_mapping(database, pictures, models, options=options)
    else:
        found = _map_incrementally(colmap, database, pictures, models, seed, count)
    if not found:
        raise DataError(why_no_model(colmap, database))
    ranked = sorted(found.values(), key=lambda m: (-m.num_reg_images(), -m.num_points3D()))
    (Path(out) / LARGEST).mkdir()
    ranked[0].write(Path(out) / LARGEST)
    parts = [sorted(m.images[i].name for i in m.reg_image_ids()) for m in ranked]
    write_json(Path(out) / PARTS, {"parts": parts})


def _map_incrementally(
    colmap: Any, database: Path, pictures: str, models: Path, seed: int, count: int
) -> dict[int, Any]:
    options = colmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed)
    # whole bundle adjustments after 20 % more frames or points rather than 10 %: as accurate on
    # short captures, in two thirds of the time
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.2
    registered = 2

    def on_progress() -> None:
        nonlocal registered
        registered += 1
        _print_progress(min(registered, count), count)

    return dict(
        colmap.incremental_mapping(
            database, pictures, models, options=options, next_image_callback=on_progress
        )
    )


def _print_progress(done: int, total: int) -> None:
    print("progress", done, total, flush=True)


def main() -> None:
    """Do the job that the command line names, with the arguments that come by stdin."""
    job, arguments = sys.argv[1], receive_arguments()
    jobs: dict[str, Callable[..., None]] = {
        "match": match,
        "match_share": match_share,
        "map": map_frames,
        "place": partial(place_between, on_progress=_print_progress),
    }
    try:
        jobs[job](**arguments)
    except DataError as error:
        print(error, flush=True)
        sys.exit(REFUSED)
    except GsdmsrError as error:  # of a child's child
        sys.exit(str(error))


if __name__ == "__main__":
    main()
