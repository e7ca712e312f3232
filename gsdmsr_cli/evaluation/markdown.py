"""Writes the results of an evaluation as Markdown, for logs of CI and for reading."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from gsdmsr_cli.evaluation import summary
from gsdmsr_cli.evaluation.gates import Verdict
from gsdmsr_cli.evaluation.summary import Document


def markdown(heading: str, document: Document, verdicts: Sequence[Verdict]) -> str:
    """Return verdicts and figures as GitHub shows them, ending with a newline."""
    about = document["protocol"]
    colours = [f"on {name}" for name in summary.backgrounds(document)]
    parts = [f"## {_text(heading)}", f"{_text(summary.title(document))}."]
    if verdicts:
        parts.append(_table(("", "check", "found"), map(_row, verdicts)))
    parts += [
        _table(("metric", *colours), summary.metric_rows(document)),
        _table(("split", "PSNR", "views"), summary.split_rows(document)),
        _table(("", ""), summary.other_rows(document)),
        f"Preset {_text(about['preset'])}, seed {about['seed']}, on "
        f"{_text(summary.machine(document))}, gsdmsr {about['versions']['gsdmsr']}, torch "
        f"{about['versions']['torch']}; data {about['data_fingerprint']}.",
    ]
    return "\n\n".join(parts) + "\n"


def _row(verdict: Verdict) -> tuple[str, str, str]:
    return "passed" if verdict.passed else "**failed**", verdict.name, verdict.found


def _table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [heads, ["---"] * len(heads), *rows]
    return "\n".join("| " + " | ".join(map(_text, line)) + " |" for line in lines)


def _text(text: str) -> str:
    """Return the text such that no character of it ends a cell or opens a tag."""
    for character, harmless in (("&", "&amp;"), ("<", "&lt;"), ("|", "\\|")):
        text = text.replace(character, harmless)
    return text
