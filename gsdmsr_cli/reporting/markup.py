"""Builds HTML tables and figures; each figure carries its unrounded value."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from typing import Any


def at(document: Any, path: str) -> Any:
    """Return what stands at a dotted path, such as "frames.3.psnr", or None."""
    for key in path.split("."):
        if isinstance(document, list):
            document = document[int(key)]
        else:
            document = document.get(key) if isinstance(document, dict) else None
    return document


def figure(document: Any, path: str, form: str = ".4f", scale: float = 1.0) -> str:
    """Return a number of the document, formatted; its unrounded value goes with it.

    Args:
        document: the report.
        path: where the number stands, see ``at``.
        form: as in f-strings.
        scale: what the number is divided by before it is formatted.
    """
    value = at(document, path)
    if value is None:
        return "none"
    shown = value if scale == 1 else value / scale
    return f'<data value="{value!r}" data-of="{escape(path)}">{shown:{form}}</data>'


def table(heads: Sequence[str], rows: Iterable[Sequence[str]], numbers: bool = True) -> str:
    """Return a table of cells that are HTML already; the first of a row is its head.

    Args:
        heads: of the columns.
        rows: with as many cells each.
        numbers: whether all cells but the first hold numbers, which are set to the right.
    """
    kind = ' class="number"' if numbers else ""
    head = "".join(
        f'<th{kind if i else ""} scope="col">{text}</th>' for i, text in enumerate(heads)
    )
    body = "".join(
        f'<tr><th scope="row">{first}</th>' + "".join(f"<td{kind}>{c}</td>" for c in rest) + "</tr>"
        for first, *rest in rows
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


def bars(rows: Sequence[tuple[str, str, float]]) -> str:
    """Return a table with a bar in each row, the longest for the largest size.

    Args:
        rows: name, figure as HTML, and size.
    """
    largest = max((size for _, _, size in rows), default=0) or 1
    body = "".join(
        f'<tr><th scope="row">{escape(name)}</th><td class="number">{text}</td>'
        f'<td class="bar"><span style="width:{100 * size / largest:.1f}%"></span></td></tr>'
        for name, text, size in rows
    )
    return f'<table class="bars"><tbody>{body}</tbody></table>'


def terms(pairs: Iterable[tuple[str, str]]) -> str:
    """Return a list of terms and what they are, both plain text."""
    entries = (f"<dt>{escape(term)}</dt><dd>{escape(text)}</dd>" for term, text in pairs)
    return f'<dl class="terms">{"".join(entries)}</dl>'
