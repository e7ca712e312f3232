"""Builds the HTML page of ``gsdmsr compare``: a table, and pictures side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

from gsdmsr_cli import __version__
from gsdmsr_cli.reporting.markup import table
from gsdmsr_cli.reporting.shell import shell


@dataclass(frozen=True)
class SideBySide:
    """One frame as several runs draw it.

    Attributes:
        name: of the frame.
        pictures: caption and URL, which holds the data, of each; the true picture first.
    """

    name: str
    pictures: tuple[tuple[str, str], ...]


def comparison_page(
    names: Sequence[str],
    rows: Sequence[Sequence[str]],
    notes: Sequence[str],
    frames: Sequence[SideBySide],
) -> str:
    """Return the page.

    Args:
        names: of the runs.
        rows: what is compared, and what each run has of it; plain text.
        notes: what the reader must know, such as other protocols.
        frames: to show.
    """
    cells = [[escape(cell) for cell in row] for row in rows]
    listed = table(("", *(escape(name) for name in names)), cells)
    said = "".join(f'<p class="note">{escape(note)}</p>' for note in notes)
    main = f'<section>\n<div class="card wide">{listed}{said}</div>\n</section>\n'
    main += "".join(map(_frame, frames))
    title = f"{', '.join(names)}: comparison"
    lede = f'<p class="lede">{len(names)} runs, the same views</p>'
    footer = f"Written by gsdmsr {escape(__version__)}."
    return shell(title, "gsdmsr comparison", " · ".join(names), lede, main, footer)


def _frame(frame: SideBySide) -> str:
    figures = "".join(
        f'<figure><img src="{url}" alt="{escape(caption)}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
        for caption, url in frame.pictures
    )
    name = escape(frame.name)
    return f'<section>\n<h2>{name}</h2>\n<div class="card side">{figures}</div>\n</section>\n'
