"""Builds the HTML page of an evaluation: one file, no network, light and dark."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from html import escape

from gsdmsr_cli.evaluation import summary
from gsdmsr_cli.evaluation.catalogue import METRICS
from gsdmsr_cli.evaluation.gates import Verdict
from gsdmsr_cli.evaluation.summary import Document, value_of
from gsdmsr_cli.reporting.frames import ReportFrame
from gsdmsr_cli.reporting.markup import at, bars, figure, table, terms
from gsdmsr_cli.reporting.plots import Log, plots
from gsdmsr_cli.reporting.shell import shell
from gsdmsr_cli.reporting.viewer import viewer
from gsdmsr_cli.scene.scene import SPLITS

_FOOTER = "unrounded, in metrics.json beside this page."

_TILE_LPIPS = ("lpips_alex", "lpips_vgg", "lpips_squeeze")
"""The first of these that has a value is shown large."""

_TIMINGS = {
    "load_s": "reading pictures",
    "compile_s": "preparing kernels",
    "stages_s.gradients": "drawing and gradients",
    "stages_s.optimizer": "optimiser",
    "stages_s.population": "growing and pruning",
    "stages_s.validation": "drawing the validation view",
    "stages_s.save": "checkpoints",
    "stages_s.other": "other",
}
_PARTS = {
    "splats_bytes": "Gaussians",
    "motion_bytes": "motion",
    "training_state_bytes": "state of training",
}


def page(
    heading: str,
    document: Document,
    verdicts: Sequence[Verdict],
    log: Log,
    shown: Sequence[ReportFrame],
    full: float,
    played: str | None = None,
) -> str:
    """Return the page.

    Args:
        heading: name of the run.
        document: the content of ``metrics.json``.
        verdicts: on what was asked of it.
        log: of the training.
        shown: frames to show, worst first.
        full: see ``viewer``.
        played: name of a page beside this one that plays the run, if there is one.
    """
    about = document["protocol"]
    lede = (
        f"{summary.title(document)} · on {' and '.join(summary.backgrounds(document))} · "
        f"preset {about['preset']}, motion {about['motion']}, seed {about['seed']}"
    )
    charts = "".join(f'<div class="card chart">{chart}</div>' for chart in plots(document, log))
    costs = _time(document) + _storage(document)
    frames = viewer(document, shown, full)
    body = [
        _section("", _verdicts(verdicts)),
        _section("Figures", f'<div class="grid">{_scores(document)}{_splits(document)}</div>'),
        _section("Over time", f'<div class="grid">{charts}</div>' if charts else ""),
        _section("Worst and best frames", f'<div class="card">{frames}</div>' if frames else ""),
        _section("Time and storage", f'<div class="grid">{costs}</div>'),
        _section("Every frame", _frames(document)),
        _section("Protocol", _protocol(document)),
    ]
    header = f'<p class="lede">{escape(lede)}</p>\n{_link(played)}{_tiles(document)}'
    version = escape(about["versions"]["gsdmsr"])
    footer = f"Written by gsdmsr {version}. Every figure here stands,\n{_FOOTER}"
    title = f"{heading}: evaluation"
    return shell(title, "gsdmsr evaluation", heading, header, "".join(body), footer, "page.js")


def _link(played: str | None) -> str:
    if played is None:
        return ""
    return f'<p><a href="{escape(played)}">See it move</a>, in {escape(played)} beside this.</p>\n'


def _section(title: str, content: str) -> str:
    if not content:
        return ""
    head = f"<h2>{escape(title)}</h2>\n" if title else ""
    return f"<section>\n{head}{content}\n</section>\n"


def _tiles(document: Document) -> str:
    split, splits = document["protocol"]["split"], document["splits"]
    others = " · ".join(
        f"{name} {figure(document, f'splits.{name}.psnr', '.2f')}"
        for name in SPLITS
        if name in splits and name != split
    )
    model = sum(document["storage"][part] for part in ("splats_bytes", "motion_bytes"))
    tiles = [
        (
            f"PSNR, {split}",
            f"{figure(document, 'aggregate.psnr', '.2f')} <small>dB</small>",
            others,
        ),
        ("SSIM", figure(document, "aggregate.ssim"), _ms_ssim(document)),
    ]
    for name in _TILE_LPIPS:
        if value_of(document["aggregate"], name) is not None:
            kind = name.removeprefix("lpips_")
            text = figure(document, f"aggregate.{name}.value")
            tiles.append((f"LPIPS, {kind}", text, "less is better"))
            break
    if value_of(document["aggregate"], "flicker") is not None:
        truth = f"the truth {figure(document, 'aggregate.flicker_true.value')}; less is better"
        tiles.append(("Flicker", figure(document, "aggregate.flicker.value"), truth))
    raster = f"{figure(document, 'speed.fps_raster', '.0f')} without motion"
    training = document["training"]
    tiles += [
        ("Frames a second", figure(document, "speed.fps", ".0f"), raster),
        ("Model", f"{model / 1e6:.2f} <small>MB</small>", f"{training['splats']:,} Gaussians"),
        (
            "Training",
            f"{figure(document, 'training.train_s', '.0f')} <small>s</small>",
            f"{training['steps']:,} steps",
        ),
    ]
    cells = "".join(
        f'<div class="tile"><dt>{title}</dt><dd>{value}</dd><dd class="under">{under}</dd></div>'
        for title, value, under in tiles
    )
    return f'<dl class="tiles">{cells}</dl>'


def _ms_ssim(document: Document) -> str:
    if value_of(document["aggregate"], "ms_ssim") is None:
        return ""
    return f"MS-SSIM {figure(document, 'aggregate.ms_ssim.value')}"


def _verdicts(verdicts: Sequence[Verdict]) -> str:
    if not verdicts:
        return ""
    items = "".join(
        f'<li class="{word}"><b>{word}</b><span>{escape(verdict.found)}</span></li>'
        for verdict in verdicts
        for word in ("passed" if verdict.passed else "failed",)
    )
    return f'<h2>Asked for</h2><div class="card"><ul class="verdicts">{items}</ul></div>'


def _scores(document: Document) -> str:
    over = summary.backgrounds(document)
    roots = ["aggregate", *(f"backgrounds.{name}.aggregate" for name in document["backgrounds"])]
    present = [metric for metric in METRICS if metric in document["aggregate"]]
    rows = [
        (metric, *(_score(document, f"{root}.{metric}") for root in roots)) for metric in present
    ]
    heads = ("mean over frames", *(f"on {name}" for name in over))
    return f'<div class="card wide">{table(heads, rows)}</div>'


def _score(document: Document, path: str) -> str:
    entry = at(document, path)
    if isinstance(entry, dict):
        missing = f'<abbr title="{escape(str(entry["reason"]))}">none</abbr>'
        return missing if entry["value"] is None else figure(document, f"{path}.value")
    return figure(document, path)


def _splits(document: Document) -> str:
    own, names = document["protocol"]["split"], [n for n in SPLITS if n in document["splits"]]
    heads = ("", *(f'<span class="own">{n}</span>' if n == own else n for n in names))
    rows = [
        ("PSNR [dB]", *(figure(document, f"splits.{n}.psnr", ".2f") for n in names)),
        ("views", *(figure(document, f"splits.{n}.frames", "d") for n in names)),
    ]
    gap = _gap(document)
    reasons = [
        (metric, entry["reason"])
        for metric, entry in document["aggregate"].items()
        if isinstance(entry, dict) and entry["value"] is None
    ]
    missing = f"<h3>Without a value</h3>{terms(reasons)}" if reasons else ""
    return f'<div class="card wide">{table(heads, rows)}{gap}{missing}</div>'


def _gap(document: Document) -> str:
    splits, own = document["splits"], document["protocol"]["split"]
    seen, unseen = (splits.get(name, {}).get("psnr") for name in ("train", own))
    if seen is None or unseen is None:
        return ""
    word = "more" if seen >= unseen else "less"
    return (
        f'<p class="note">Views that it was trained on score {abs(seen - unseen):.2f} dB {word} '
        f"than those of {own}.</p>"
    )


def _time(document: Document) -> str:
    rows = [
        (name, f"{figure(document, f'training.{path}', '.1f')} s", value)
        for path, name in _TIMINGS.items()
        if (value := at(document, f"training.{path}")) is not None
    ]
    return f'<div class="card"><h3>Time of the training by part</h3>{bars(rows)}</div>'


def _storage(document: Document) -> str:
    rows = [
        (name, f"{figure(document, f'storage.{part}', '.2f', 1e6)} MB", document["storage"][part])
        for part, name in _PARTS.items()
    ]
    whole = figure(document, "storage.checkpoint_bytes", ".2f", 1e6)
    note = f'<p class="note">The file of the checkpoint has {whole} MB.</p>'
    return f'<div class="card"><h3>Storage by part</h3>{bars(rows)}{note}</div>'


def _frames(document: Document) -> str:
    present = [m for m in METRICS if any(m in frame for frame in document["frames"])]
    rows = [
        (
            escape(str(frame["name"])),
            figure(document, f"frames.{i}.time", ".3f"),
            *(figure(document, f"frames.{i}.{m}") if m in frame else "" for m in present),
        )
        for i, frame in enumerate(document["frames"])
    ]
    shown = table(("frame", "time", *present), rows)
    count = len(document["frames"])
    return f'<details class="card wide"><summary>All {count} frames</summary>{shown}</details>'


def _of_views(told: Document, of: str = "") -> Iterator[tuple[str, str]]:
    """Yield what layers have done to views of the split, by layer, or by segment and layer."""
    for key, found in told.items():
        name = of + key
        if "about" not in found:
            yield from _of_views(found, f"segment {name}, ")
        elif (offsets := found.get("time_offsets")) is not None:
            most = max(map(abs, offsets))
            yield name, f"{found['about']}; by at most {most:.2f} frames earlier or later"
        else:
            yield (
                name,
                f"{found['about']}; of the split {found['own']} have their own, "
                f"{found['of_neighbours']} that of neighbours, {found['none']} none",
            )


def _protocol(document: Document) -> str:
    about = document["protocol"]
    width, height = about["resolution"]
    pairs: Iterable[tuple[str, str]] = (
        ("pictures", f"{width} x {height} px, the data's sides divided by {about['downscale']}"),
        ("checkpoint", f"{about['checkpoint']}, step {about['checkpoint_step']}"),
        ("device", summary.machine(document)),
        ("data", about["data_fingerprint"]),
        *_of_views(about.get("views", {})),
        *(about["conventions"].items()),
        ("versions", ", ".join(f"{name} {text}" for name, text in about["versions"].items())),
    )
    return f'<div class="card">{terms(pairs)}</div>'
