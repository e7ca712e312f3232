"""The part of the page that shows frames: true and drawn under a divider, and the error beside."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

from gsdmsr_cli.evaluation.summary import Document
from gsdmsr_cli.reporting.markup import figure
from gsdmsr_cli.reporting.stills import Still

SMALL = 320
"""Pictures of fewer pixels on their longest side show these as squares rather than blurred."""


def viewer(document: Document, stills: Sequence[Still], full: float) -> str:
    """Return all frames, of which radio buttons let one be seen at a time.

    Args:
        document: the report.
        stills: the frames, worst first.
        full: mean difference of the colours at which those of the error end.
    """
    if not stills:
        return ""
    buttons = "".join(_button(document, still, still is stills[0]) for still in stills)
    strips = _strip(document, "Worst", [still for still in stills if still.worst])
    strips += _strip(document, "Best", [still for still in stills if not still.worst])
    shots = "".join(_shot(document, still, full) for still in stills)
    return (
        f"<style>{''.join(map(_rules, stills))}</style>"
        f'<fieldset class="viewer" aria-label="Frame to show">{buttons}'
        f'<div class="strip">{strips}</div>{shots}</fieldset>'
    )


def _rules(still: Still) -> str:
    own, label = f"#s{still.index}", f".strip label[for=s{still.index}]"
    return (
        f"{own}:checked~#f{still.index}{{display:block}}"
        f"{own}:checked~{label}{{border-color:var(--accent)}}"
        f"{own}:focus-visible~{label}{{outline:3px solid var(--accent)}}"
    )


def _button(document: Document, still: Still, checked: bool) -> str:
    name = escape(_name(document, still))
    return (
        f'<input type="radio" name="shot" id="s{still.index}"{" checked" if checked else ""} '
        f'aria-label="{name}">'
    )


def _strip(document: Document, title: str, stills: Sequence[Still]) -> str:
    if not stills:
        return ""
    labels = "".join(
        f'<label for="s{still.index}"><img src="{still.thumbnail}" alt="">'
        f"{figure(document, f'frames.{still.index}.psnr', '.2f')} dB"
        f"<span>{escape(_name(document, still))}</span></label>"
        for still in stills
    )
    return f'<div><h3>{title}</h3><div class="thumbs">{labels}</div></div>'


def _shot(document: Document, still: Still, full: float) -> str:
    name = escape(_name(document, still))
    size = f'width="{still.width}" height="{still.height}"'
    ratio = f"--ratio:{still.width / still.height:.4f}"
    small = " small" if max(still.width, still.height) < SMALL else ""
    return (
        f'<figure class="shot" id="f{still.index}"><div class="pair{small}" style="{ratio}">'
        '<div class="compare">'
        f'<img {size} src="{still.true}" alt="ground truth of {name}">'
        f'<img class="drawn" {size} src="{still.drawn}" alt="render of {name}">'
        '<span class="tag left">ground truth</span><span class="tag right">render</span>'
        '<input type="range" min="0" max="100" value="50" step="1" '
        f'aria-label="How much of the ground truth of {name} covers the render, in per cent"></div>'
        f'<div class="error"><img {size} src="{still.error}" alt="error of {name}">'
        f'<span class="tag left">error</span></div></div>'
        f"<figcaption><span><strong>{name}</strong> · "
        f"time {figure(document, f'frames.{still.index}.time', '.3f')} · "
        f"PSNR {figure(document, f'frames.{still.index}.psnr', '.2f')} dB · "
        f"SSIM {figure(document, f'frames.{still.index}.ssim')}</span>"
        f'<span class="scale">0 <i></i> {full:g} mean colour difference</span>'
        "</figcaption></figure>"
    )


def _name(document: Document, still: Still) -> str:
    return str(document["frames"][still.index]["name"])
