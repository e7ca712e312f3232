"""Looks at videos, pictures, exported splats and reports, for ``gsdmsr info``."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from gsdmsr_cli.capture.source import Source
from gsdmsr_cli.commands._found import Found
from gsdmsr_cli.commands._progress import progress_bar
from gsdmsr_cli.evaluation.gates import read_report
from gsdmsr_cli.evaluation.summary import value_of
from gsdmsr_cli.ground.errors import DataError
from gsdmsr_cli.scene.imaging import image_size
from gsdmsr_cli.scene.picture_files import IN_CAPTURES
from gsdmsr_cli.scene.vertices import read_vertices
from gsdmsr_cli.scene.video import read_video, video_length

_SHOWN = 5
"""Problems of one kind that are told."""


def video_found(path: Path) -> Found:
    """Return what a video is; all of it is decoded."""
    times: list[float] = []
    sizes: set[tuple[int, int]] = set()
    problems = []
    try:
        total = video_length(path)
        with progress_bar(f"decoding {path.name}") as on_progress:
            for time, picture in read_video(path):
                times.append(time)
                sizes.add((picture.shape[1], picture.shape[0]))
                on_progress(len(times), max(total, len(times)))
    except DataError as error:
        problems.append(str(error))
    lasts = times[-1] if times else 0.0
    rate = round((len(times) - 1) / lasts, 3) if lasts else None
    facts = {
        "frames": len(times),
        "size": list(min(sizes, default=())),
        "seconds": round(lasts, 3),
        "frames_a_second": rate,
        "bytes": path.stat().st_size,
    }
    return Found("video", facts, tuple(problems))


def source_found(source: Source) -> Found:
    """Return what a folder of pictures or videos is."""
    if source.kind == "video":
        each = {path.name: video_found(path) for path in source.files}
        problems = [problem for found in each.values() for problem in found.problems]
        videos = {name: dict(found.facts) for name, found in each.items()}
        return Found("folder of videos", {"videos": videos}, tuple(problems))
    sizes: dict[tuple[int, int], int] = {}
    problems = []
    for path in source.files:
        try:
            size = image_size(path, IN_CAPTURES)
            sizes[size] = sizes.get(size, 0) + 1
        except DataError as error:
            problems.append(str(error))
    shown = {f"{width} x {height}": count for (width, height), count in sizes.items()}
    facts = {"pictures": len(source.files), "sizes": shown}
    return Found("folder of pictures", facts, tuple(problems[:_SHOWN]))


def ply_found(path: Path) -> Found:
    """Return what a PLY file is: splats as ``gsdmsr export`` writes them, or points."""
    try:
        rows = read_vertices(path)
    except DataError as error:
        return Found("PLY file", {}, (str(error),))
    names = rows.dtype.names or ()
    splats = {"rot_0", "scale_0", "opacity", "f_dc_0"} <= set(names)
    rest = sum(name.startswith("f_rest_") for name in names)
    facts: dict[str, Any] = {"splats" if splats else "points": len(rows)}
    if splats:
        facts["sh_degree"] = round((rest // 3 + 1) ** 0.5) - 1
    finite = all(bool(np.isfinite(rows[name]).all()) for name in names)
    if finite and len(rows) and {"x", "y", "z"} <= set(names):
        facts["from"] = [round(float(rows[axis].min()), 4) for axis in "xyz"]
        facts["to"] = [round(float(rows[axis].max()), 4) for axis in "xyz"]
    problems = [] if finite else [f"{path}: holds values that are NaN or infinite"]
    problems += [] if len(rows) else [f"{path}: is empty"]
    facts["bytes"] = path.stat().st_size
    return Found("splats" if splats else "points", facts, tuple(problems))


def sequence_found(folder: Path, files: list[Path]) -> Found:
    """Return what a folder of PLY files is, one for every moment."""
    each = [ply_found(path) for path in files]
    problems = [problem for found in each for problem in found.problems]
    kinds = {found.kind for found in each if found.sound}
    if len(kinds) > 1:
        problems.append(f"{folder}: some of its PLY files are splats and some are points")
    problems += _gaps(folder, files)
    counts = [count for found in each for count in (found.facts.get("splats"),) if count]
    total = sum(path.stat().st_size for path in files)
    splats = [min(counts, default=0), max(counts, default=0)]
    facts = {"files": len(files), "splats_from_to": splats, "bytes": total}
    return Found("PLY sequence", facts, tuple(problems[:_SHOWN]))


def _gaps(folder: Path, files: list[Path]) -> list[str]:
    """Return a problem if the numbers at the ends of the names have gaps."""
    ends = [re.search(r"\d+$", path.stem) for path in files]
    numbers = {int(end[0]) for end in ends if end and len(end[0]) < 10}
    if len(numbers) < len(files):
        return []
    missing = max(numbers) - min(numbers) + 1 - len(numbers)
    return [f"{folder}: {missing} files of the sequence are missing"] if missing else []


def report_found(path: Path) -> Found:
    """Return what a report of ``gsdmsr eval`` is."""
    try:
        document = read_report(path)
    except DataError as error:
        return Found("report of eval", {}, (str(error),))
    about, aggregate = document["protocol"], document["aggregate"]
    facts = {key: about.get(key) for key in ("split", "resolution", "background", "preset")}
    facts["step"] = about.get("checkpoint_step")
    facts |= {metric: value_of(aggregate, metric) for metric in aggregate}
    return Found("report of eval", facts)
