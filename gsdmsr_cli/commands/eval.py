"""gsdmsr eval: measures a run on views that it has not been trained on."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from rich.markup import escape
from rich.table import Table

from gsdmsr_cli.commands import export
from gsdmsr_cli.commands._measure import describe, measure
from gsdmsr_cli.commands._trained import Trained, open_trained
from gsdmsr_cli.evaluation import summary
from gsdmsr_cli.evaluation.gates import Verdict, read_gates
from gsdmsr_cli.evaluation.junit import junit
from gsdmsr_cli.evaluation.markdown import markdown
from gsdmsr_cli.evaluation.request import BOTH, Demands, Output, Request
from gsdmsr_cli.evaluation.summary import Document
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError, ThresholdError, UsageError
from gsdmsr_cli.ground.files import require_folder, write_json, write_text
from gsdmsr_cli.ground.locks import sole_writer
from gsdmsr_cli.reporting.frames import make_report_frames
from gsdmsr_cli.reporting.page import page
from gsdmsr_cli.runs.outputs import EVALUATION, METRICS, PLAYED, REPORTS

SUMMARY_VARIABLE = "GITHUB_STEP_SUMMARY"
"""Environment variable in which GitHub Actions names the file of a step's summary."""


def run(
    run_folder: Path,
    request: Request | None = None,
    demands: Demands | None = None,
    output: Output | None = None,
    data: Path | None = None,
) -> None:
    """Write ``RUN/eval/metrics.json`` and print it, as a table or as JSON.

    Raises:
        UsageError: a demand names no metric or no number, or --junit is given without one.
        DataError: the run, its data, the weights or the baseline cannot be used, or a file cannot
            be written.
        ThresholdError: a demand is not met; everything is written all the same.
    """
    request, demands, output = request or Request(), demands or Demands(), output or Output()
    gates = read_gates(demands)
    if output.junit and not (gates.bounds or gates.baseline):
        raise UsageError("--junit has nothing to tell of: give a threshold or a --baseline")
    summary_path = _summary_path() if output.github_summary else None
    background = None if request.background == BOTH else request.background
    with ExitStack() as held:
        given = run_folder, data, background, request.downscale, request.verify_data
        trained = held.enter_context(open_trained(*given))
        protocol, folder = (
            describe(trained, request),
            output.folder or trained.run.results / EVALUATION,
        )
        if gates.baseline:
            gates.baseline.require_same(protocol)
        held.enter_context(sole_writer(folder))
        if output.junit:
            require_folder(output.junit.parent, "choose another --junit or change the rights")
        if output.play:
            require_folder(folder)
            export.write(run_folder, "html", {}, (), folder / PLAYED, data)
        document = measure(trained, request)
        verdicts = gates.judge(document)
        write_json(folder / METRICS, document)
        if output.junit:
            write_text(output.junit, junit("gsdmsr.eval", document, verdicts))
        if summary_path:
            _append(summary_path, markdown(_heading(run_folder), document, verdicts))
        if output.report:
            _report(folder, trained, document, verdicts, PLAYED if output.play else None)
    say.result(document, *_shown(document, verdicts, folder, output))  # last of all
    missed = [verdict.found for verdict in verdicts if not verdict.passed]
    if missed:
        raise ThresholdError("; ".join(missed))


def _heading(run_folder: Path) -> str:
    return f"gsdmsr eval {run_folder.resolve().name}"


def _report(
    folder: Path,
    trained: Trained,
    document: Document,
    verdicts: Sequence[Verdict],
    played: str | None,
) -> None:
    """Write the report for people, as HTML and as Markdown."""
    root = trained.run.root
    views, frames = trained.scene.split(document["protocol"]["split"]), document["frames"]
    shown, full = make_report_frames(trained.renderer, views, frames)
    log = trained.run.read_log()
    html = page(root.resolve().name, document, verdicts, log, shown, full, played)
    write_text(folder / REPORTS[0], markdown(_heading(root), document, verdicts))
    write_text(folder / REPORTS[1], html)


def _summary_path() -> Path:
    named = os.environ.get(SUMMARY_VARIABLE)
    if not named:
        raise UsageError(f"--github-summary: {SUMMARY_VARIABLE} is not set; GitHub Actions sets it")
    return Path(named)


def _append(path: Path, text: str) -> None:
    try:
        with path.open("a", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        raise DataError(f"{path}: cannot be written: {error.strerror or error}") from error


def _shown(
    document: Document, verdicts: Sequence[Verdict], folder: Path, output: Output
) -> list[Table | str]:
    """Return the document for people."""
    lines = [f"{'passed' if v.passed else 'FAILED'}: {v.found}" for v in verdicts]
    lines += [f"written to {folder / METRICS}"]
    lines += [f"report: {folder / REPORTS[1]}"] if output.report else []
    lines += [f"a page that plays it: {folder / PLAYED}"] if output.play else []
    return [_table(document), *lines]


def _table(document: Document) -> Table:
    colours = [f"on {name}" for name in summary.backgrounds(document)]
    table = Table("metric", *colours, title=summary.title(document))
    for row in summary.metric_rows(document):
        table.add_row(*map(escape, row))
    for split, psnr, _ in summary.split_rows(document):
        if split != document["protocol"]["split"]:
            table.add_row(f"psnr of {split} views", psnr)
    for row in summary.other_rows(document):
        table.add_row(*map(escape, row))
    return table
