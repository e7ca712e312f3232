"""Measures a run and returns the document that ``gsdmsr eval`` writes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from gsdmsr_cli.backends.cuda import availability
from gsdmsr_cli.commands._progress import part_of, progress_bar
from gsdmsr_cli.commands._trained import Trained
from gsdmsr_cli.evaluation import protocol
from gsdmsr_cli.evaluation.catalogue import PARTS, Metric, load_metrics
from gsdmsr_cli.evaluation.flicker import Flicker, consecutive, figures, measure_flicker
from gsdmsr_cli.evaluation.lpips import weights_hashes
from gsdmsr_cli.evaluation.metrics import Missing
from gsdmsr_cli.evaluation.request import BOTH, Request
from gsdmsr_cli.evaluation.speed import measure_speed
from gsdmsr_cli.evaluation.summary import SCHEMA
from gsdmsr_cli.ground import machine
from gsdmsr_cli.options.preset import BACKGROUNDS
from gsdmsr_cli.scene.picture_hashes import digest
from gsdmsr_cli.scene.scene import SPLITS, View
from gsdmsr_cli.training.timings import timings_of

OTHER_VIEWS = 20
"""Views of every other split, evenly spaced, whose PSNR is reported beside that of the split."""

Scored = Sequence[tuple[View, protocol.Scores]]

_Task = tuple[str, protocol.ViewRenderer, Sequence[View], Mapping[str, Metric | Missing] | None]
"""What is scored in one go: a split or background, and the views and metrics wanted of it."""


def measure(trained: Trained, request: Request) -> dict[str, Any]:
    """Return the document of ``metrics.json``.

    Raises:
        DataError: the split has no views, or pictures, masks or weights cannot be read.
        UsageError: the pictures are too small for the downscale.
    """
    views, renderer = trained.scene.split(request.split), trained.renderer
    cameras = [renderer.pictures.camera(view) for view in views]
    sizes = [(camera.width, camera.height) for camera in cameras]
    metrics = load_metrics(min(sizes, key=min), request.lpips_weights, request.lpips_inria)
    _, *others = _backgrounds(trained, request)
    chosen = _views_by_split(trained, request.split)
    work: list[_Task] = [
        (split, renderer, own, metrics if split == request.split else None)
        for split, own in chosen.items()
    ]
    over = {name: renderer.over(BACKGROUNDS[name]) for name in others}
    work += [(name, renderer, views, metrics) for name, renderer in over.items()]
    scored = _score_all(work)
    flicker = _flicker_over({request.split: renderer, **over}, views, trained.scene.views)
    shots = list(zip(cameras, (view.time for view in views), strict=True))
    speed = measure_speed(renderer.model, shots, renderer.engine, renderer.background)
    return {
        "schema": SCHEMA,
        "protocol": describe(trained, request),
        **_results(scored[request.split], metrics, flicker[request.split]),
        "splits": {
            split: {"psnr": _mean(scored[split])["psnr"], "frames": len(own)}
            for split, own in chosen.items()
        },
        "backgrounds": {name: _results(scored[name], metrics, flicker[name]) for name in others},
        "speed": speed.document(),
        "storage": {
            "checkpoint_bytes": trained.checkpoint.file_bytes,
            **protocol.storage(trained.checkpoint.sizes()),
        },
        "training": _training(trained),
    }


def _score_all(work: Sequence[_Task]) -> dict[str, Scored]:
    """Return the scores of every task by its name."""
    total = sum(len(views) for _, _, views, _ in work)
    scored: dict[str, Scored] = {}
    with progress_bar("comparing pictures") as on_progress:
        for name, renderer, views, metrics in work:
            of_all = part_of(on_progress, sum(map(len, scored.values())), total)
            scored[name] = protocol.score_views(renderer, views, metrics, of_all)
    return scored


def _flicker_over(
    renderers: Mapping[str, protocol.ViewRenderer], views: Sequence[View], scene: Sequence[View]
) -> dict[str, Flicker | Missing]:
    """Return the flicker of the views and their neighbours, by the names of the renderers."""
    pairs = consecutive(views, scene)
    if isinstance(pairs, Missing):
        return dict.fromkeys(renderers, pairs)
    found, total = dict[str, Flicker | Missing](), len(renderers) * len(pairs)
    with progress_bar("comparing consecutive pictures") as on_progress:
        for name, renderer in renderers.items():
            of_all = part_of(on_progress, len(found) * len(pairs), total)
            found[name] = measure_flicker(renderer, pairs, of_all)
    return found


def _backgrounds(trained: Trained, request: Request) -> list[str]:
    own = trained.run.preset.data.background
    if request.background == BOTH:
        return [own, *(name for name in BACKGROUNDS if name != own)]
    return [request.background or own]


def _views_by_split(trained: Trained, split: str) -> dict[str, Sequence[View]]:
    """Return all views of one split, first, and some of every other there is."""
    chosen: dict[str, Sequence[View]] = {split: trained.scene.split(split)}
    for other in SPLITS:
        views = [view for view in trained.scene.views if view.split == other]
        if views and other != split:
            chosen[other] = _evenly(views, OTHER_VIEWS)
    return chosen


def _evenly(views: Sequence[View], count: int) -> list[View]:
    """Return ``count`` of the views, or all if there are fewer."""
    count = min(count, len(views))
    return [views[i * len(views) // count] for i in range(count)]


def describe(trained: Trained, request: Request) -> dict[str, Any]:
    """Return the document's ``protocol``, which is known before anything is measured.

    Raises:
        DataError: the split has no views.
        UsageError: the pictures are too small for the downscale.
    """
    options, checkpoint = trained.run.preset, trained.checkpoint
    views = trained.scene.split(request.split)
    camera = trained.renderer.pictures.camera(views[0])
    told = trained.renderer.model.tell_views([(view.camera, view.time) for view in views])
    return {
        "split": request.split,
        "resolution": [camera.width, camera.height],
        "downscale": request.downscale or options.data.downscale,
        "background": _backgrounds(trained, request)[0],
        "checkpoint": "last",
        "checkpoint_step": checkpoint.step,
        "checkpoint_sha256": checkpoint.sha256,
        "progress": checkpoint.progress,
        "device": trained.device,
        "processor": machine.cpu_name(),
        "gpu": availability.usage(trained.device)["gpu"],
        "preset": trained.run.name,
        "motion": options.motion["name"],
        "seed": options.training.seed,
        "data_fingerprint": trained.run.fingerprint,
        "pictures_fingerprint": digest(trained.scene.pictures),
        "lpips_weights": weights_hashes(request.lpips_weights),
        "conventions": protocol.CONVENTIONS,
        **({"views": told} if told else {}),
        "versions": machine.versions(),
    }


def _results(
    scored: Scored, metrics: Mapping[str, Metric | Missing], flicker: Flicker | Missing
) -> dict[str, Any]:
    """Return what has come out over one background: the aggregate and every frame."""
    counts = {part: sum(f"psnr_{part}" in scores for _, scores in scored) for part in PARTS}
    known = {} if isinstance(flicker, Missing) else asdict(flicker)
    return {
        "aggregate": {**protocol.with_reasons(_mean(scored), metrics), **figures(flicker)},
        "parts": {part: {"frames": count} for part, count in counts.items() if count},
        "consecutive": {key: known.get(key, 0) for key in ("pairs", "pixels")},
        "frames": [{"name": view.name, "time": view.time, **scores} for view, scores in scored],
    }


def _mean(scored: Scored) -> protocol.Scores:
    return protocol.average([scores for _, scores in scored])


def _training(trained: Trained) -> dict[str, Any]:
    """Return how long the training took; of one that was killed there is only the log."""
    checkpoint, splats = trained.checkpoint, len(trained.renderer.model.splats)
    known = {"steps": checkpoint.step, "train_s": checkpoint.elapsed, "splats": splats}
    account = known | trained.run.account(checkpoint.step)
    return account | {"stages_s": _timings(trained, account["train_s"])}


def _timings(trained: Trained, total: float) -> dict[str, float]:
    """Return the seconds of each timing of the training, by the log; the rest is "other"."""
    seconds: dict[str, float] = {}
    for entry in trained.run.read_log():
        if entry["step"] <= trained.checkpoint.step:
            for name, spent in timings_of(entry).items():
                seconds[name] = seconds.get(name, 0.0) + spent
    if not seconds:
        return {}
    rest = max(total - sum(seconds.values()), 0.0)
    return {name: round(spent, 3) for name, spent in (seconds | {"other": rest}).items()}
