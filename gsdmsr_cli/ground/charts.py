"""Line charts as SVG, legible on light and dark ground."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from itertools import cycle
from xml.sax.saxutils import escape, quoteattr

WIDTH, HEIGHT = 720, 400
_LEFT, _RIGHT, _TOP, _BOTTOM = 56, 16, 78, 48
_TICKS = 6

COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#999999")
"""Colours that the colour-blind distinguish as well (Okabe & Ito 2008)."""

_STYLE = (
    "svg{font:13px system-ui,sans-serif;fill:#222;color:#222}"
    "path{fill:none;stroke-width:1.8;stroke-linejoin:round}"
    ".grid{stroke:#8884;stroke-width:1}"
    "@media(prefers-color-scheme:dark){svg{fill:#ddd;color:#ddd}}"
)


@dataclass(frozen=True)
class Line:
    """A line of a chart.

    Attributes:
        name: what it stands for; lines of one name share a colour and an entry of the legend.
        points: (x, y) in the order of x.
        labels: of the points, which are then drawn as dots that show them under the mouse.
    """

    name: str
    points: Sequence[tuple[float, float]]
    labels: Sequence[str] = ()


def line_chart(
    title: str,
    x_label: str,
    y_label: str,
    lines: Iterable[Line],
    size: tuple[int, int] = (WIDTH, HEIGHT),
) -> str:
    """Return an SVG of all lines with at least two points, and axes that fit them.

    Its text is 13 units high, of which ``size`` (width, height) has so many.
    """
    width, height = size
    drawn = [line for line in lines if len(line.points) > 1]
    x_ticks = _ticks([x for line in drawn for x, _ in line.points])
    y_ticks = _ticks([y for line in drawn for _, y in line.points])
    across = _scale(x_ticks, _LEFT, width - _RIGHT)
    up = _scale(y_ticks, height - _BOTTOM, _TOP)
    colours = dict(zip(dict.fromkeys(line.name for line in drawn), cycle(COLOURS), strict=False))
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img"'
        f" aria-label={quoteattr(title)}><style>{_STYLE}</style>",
        _text(_LEFT, 22, title, weight="bold"),
        _text((_LEFT + width - _RIGHT) / 2, height - 10, x_label, anchor="middle"),
        _text(8, _TOP - 14, y_label),
    ]
    for tick in x_ticks:
        parts.append(_rule(across(tick), height - _BOTTOM, across(tick), _TOP))
        parts.append(_text(across(tick), height - _BOTTOM + 18, f"{tick:g}", anchor="middle"))
    for tick in y_ticks:
        parts.append(_rule(_LEFT, up(tick), width - _RIGHT, up(tick)))
        parts.append(_text(_LEFT - 8, up(tick) + 4, f"{tick:g}", anchor="end"))
    for line in drawn:
        places = " ".join(f"{across(x):.1f},{up(y):.1f}" for x, y in line.points)
        parts.append(f'<path stroke="{colours[line.name]}" d="M{places}"/>')
        for (x, y), label in zip(line.points, line.labels, strict=False):
            parts.append(_dot(across(x), up(y), colours[line.name], label))
    at = float(_LEFT)
    for name, colour in colours.items():
        parts.append(f'<circle cx="{at + 5:.0f}" cy="39" r="5" fill="{colour}"/>')
        parts.append(_text(at + 15, 43, name))
        at += 33 + 7.2 * len(name)
    return "\n".join([*parts, "</svg>\n"])


def _ticks(values: Sequence[float]) -> list[float]:
    """Return about six round numbers, evenly spaced, that reach from below to above the values."""
    low, high = (min(values), max(values)) if values else (0.0, 1.0)
    largest = max(abs(low), abs(high))
    # ticks are written with six digits; of a line that is level they may lie farther apart
    span = max(high - low, (1e-4 if high > low else 0.1) * largest)
    span = span if span > 1e-12 else 1.0
    power = 10 ** math.floor(math.log10(span / _TICKS))
    step = next(s * power for s in (1, 2, 5, 10, 20) if span / (s * power) <= _TICKS)
    first, last = math.floor(low / step + 1e-9), math.ceil(high / step - 1e-9)
    return [float(f"{k * step:.12g}") for k in range(first, max(last, first + 1) + 1)]


def _scale(ticks: Sequence[float], low: float, high: float) -> Callable[[float], float]:
    """Return what takes the first and the last tick to two places on the page."""
    factor = (high - low) / (ticks[-1] - ticks[0])
    return lambda value: low + (value - ticks[0]) * factor


def _rule(x1: float, y1: float, x2: float, y2: float) -> str:
    return f'<path class="grid" d="M{x1:.1f},{y1:.1f} {x2:.1f},{y2:.1f}"/>'


def _dot(x: float, y: float, colour: str, label: str) -> str:
    title = f"<title>{escape(label)}</title>"
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3.5" fill="{colour}">{title}</circle>'


def _text(x: float, y: float, text: str, anchor: str = "start", weight: str = "normal") -> str:
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-weight="{weight}">'
        f"{escape(text)}</text>"
    )
