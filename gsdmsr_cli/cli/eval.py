"""The options of `gsdmsr eval`, and the call of the command with them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from gsdmsr_cli.cli.options import MovedData, RunFolder, VerifyData


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("eval")(evaluate)


def evaluate(
    run_folder: RunFolder,
    split: Annotated[Literal["test", "val"], typer.Option(help="Views to compare.")] = "test",
    background: Annotated[
        Literal["white", "black", "both"] | None,
        typer.Option(help="Instead of the one trained with."),
    ] = None,
    downscale: Annotated[
        int | None, typer.Option(min=1, help="Instead of the one trained with.")
    ] = None,
    lpips_weights: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder of LPIPS weights.")
    ] = None,
    lpips_inria: Annotated[
        bool, typer.Option("--lpips-inria", help="LPIPS on [0, 1] too, as in tables after 3DGS.")
    ] = False,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder to write, if not RUN/eval.")
    ] = None,
    fail_under: Annotated[
        list[str] | None,
        typer.Option(metavar="METRIC=VALUE", help="Exit with 4 if it is less; repeatable."),
    ] = None,
    fail_over: Annotated[
        list[str] | None,
        typer.Option(metavar="METRIC=VALUE", help="Exit with 4 if it is more; repeatable."),
    ] = None,
    baseline: Annotated[
        Path | None,
        typer.Option(metavar="F.json", help="Exit with 4 if worse than this metrics.json."),
    ] = None,
    tolerance: Annotated[
        list[str] | None,
        typer.Option(metavar="METRIC=VALUE", help="How much worse it may be; repeatable."),
    ] = None,
    junit: Annotated[
        Path | None, typer.Option(metavar="F.xml", help="Write what passed as JUnit XML.")
    ] = None,
    github_summary: Annotated[
        bool, typer.Option("--github-summary", help="Append to the summary of GitHub Actions.")
    ] = False,
    report: Annotated[
        bool, typer.Option("--report", help="Write report.html and report.md too.")
    ] = False,
    play: Annotated[
        bool, typer.Option("--play", help="Write a page too that plays the run.")
    ] = False,
    data: MovedData = None,
    verify_data: VerifyData = False,
) -> None:
    """Measure a run on views it has not seen."""
    from gsdmsr_cli.evaluation.request import Demands, Output, Request

    request = Request(split, background, downscale, lpips_weights, lpips_inria, verify_data)
    demands = Demands(
        tuple(fail_under or ()), tuple(fail_over or ()), baseline, tuple(tolerance or ())
    )
    output = Output(out, junit, github_summary, report, play)
    from gsdmsr_cli.commands import eval as command

    command.run(run_folder, request, demands, output, data)
