"""Builds the part of the HTML page that compares frames: true, rendered and error."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from gsdmsr_cli.evaluation.summary import Document
from gsdmsr_cli.reporting.frames import ReportFrame
from gsdmsr_cli.reporting.markup import figure

SMALL = 320
"""Pictures of fewer pixels on their longest side show these as squares rather than blurred."""


def viewer(document: Document, shown: Sequence[ReportFrame], full: float) -> str:
    """Return all frames, of which radio buttons let one be seen at a time.

    Args:
        document: the report.
        shown: the frames, worst first.
        full: mean difference of the colours at which those of the error end.
    """
    if not shown:
        return ""
    buttons = "".join(_button(document, frame, frame is shown[0]) for frame in shown)
    strips = _strip(document, "Worst", [frame for frame in shown if frame.worst])
    strips += _strip(document, "Best", [frame for frame in shown if not frame.worst])
    shots = "".join(_shot(document, frame, full) for frame in shown)
    return (
        f"<style>{''.join(map(_rules, shown))}</style>"
        f'<fieldset class="viewer" aria-label="Frame to show">{buttons}'
        f'<div class="strip">{strips}</div>{shots}</fieldset>'
    )


def _rules(frame: ReportFrame) -> str:
    own, label = f"#s{frame.index}", f".strip label[for=s{frame.index}]"
    return (
        f"{own}:checked~#f{frame.index}{{display:block}}"
        f"{own}:checked~{label}{{border-color:var(--accent)}}"
        f"{own}:focus-visible~{label}{{outline:3px solid var(--accent)}}"
    )


def _button(document: Document, frame: ReportFrame, checked: bool) -> str:
    name = escape(_name(document, frame))
    return (
        f'<input type="radio" name="shot" id="s{frame.index}"{" checked" if checked else ""} '
        f'aria-label="{name}">'
    )


def _strip(document: Document, title: str, shown: Sequence[ReportFrame]) -> str:
    if not shown:
        return ""
    labels = "".join(
        f'<label for="s{frame.index}"><img src="{frame.thumbnail}" alt="">'
        f"{figure(document, f'frames.{frame.index}.psnr', '.2f')} dB"
        f"<span>{escape(_name(document, frame))}</span></label>"
        for frame in shown
    )
    return f'<div><h3>{title}</h3><div class="thumbs">{labels}</div></div>'


def _shot(document: Document, frame: ReportFrame, full: float) -> str:
    name = escape(_name(document, frame))
    size = f'width="{frame.width}" height="{frame.height}"'
    ratio = f"--ratio:{frame.width / frame.height:.4f}"
    small = " small" if max(frame.width, frame.height) < SMALL else ""
    return (
        f'<figure class="shot" id="f{frame.index}"><div class="pair{small}" style="{ratio}">'
        '<div class="compare">'
        f'<img {size} src="{frame.true}" alt="ground truth of {name}">'
        f'<img class="drawn" {size} src="{frame.drawn}" alt="render of {name}">'
        '<span class="tag left">ground truth</span><span class="tag right">render</span>'
        '<input type="range" min="0" max="100" value="50" step="1" '
        f'aria-label="How much of the ground truth of {name} covers the render, in per cent"></div>'
        f'<div class="error"><img {size} src="{frame.error}" alt="error of {name}">'
        f'<span class="tag left">error</span></div></div>'
        f"<figcaption><span><strong>{name}</strong> · "
        f"time {figure(document, f'frames.{frame.index}.time', '.3f')} · "
        f"PSNR {figure(document, f'frames.{frame.index}.psnr', '.2f')} dB · "
        f"SSIM {figure(document, f'frames.{frame.index}.ssim')}</span>"
        f'<span class="scale">0 <i></i> {full:g} mean colour difference</span>'
        "</figcaption></figure>"
    )


def _name(document: Document, frame: ReportFrame) -> str:
    return str(document["frames"][frame.index]["name"])
