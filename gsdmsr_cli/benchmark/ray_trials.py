"""Trials on the workers of a Ray cluster."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from gsdmsr_cli.benchmark.trials import Terms, Trial, left_to_do, report_of
from gsdmsr_cli.calling.on_ray import connected, needs_of, require_workers
from gsdmsr_cli.calling.ray_calls import call_on_ray


def run_on_ray(
    trials: Sequence[Trial],
    root: Path,
    terms: Terms,
    on_report: Callable[[Trial, dict[str, Any]], None],
) -> None:
    """Do what ``run_trial`` does for all, on the workers of a cluster that see the same storage.

    Args:
        trials: with absolute paths.
        root: folder of the runs, absolute.
        terms: of all trials.
        on_report: called with each trial that has come to its end, and its ``metrics.json``.

    Raises:
        UsageError, DataError: there is no Ray, no such cluster, or workers lack something.
        DataError, GsdmsrError, KeyboardInterrupt: see ``run_side_by_side``.
    """
    by_log = {trial.log(root): trial for trial in trials}
    works = {log: partial(left_to_do, trial, root, terms) for log, trial in by_log.items()}
    files = [trial.preset for trial in trials if isinstance(trial.preset, Path)]
    weights = [terms.lpips_weights] if terms.lpips_weights else []
    inputs = dict.fromkeys([*(trial.scene for trial in trials), *files, *weights])
    with connected(str(terms.workers)) as ray, needs_of(root, [*inputs]) as needs:
        require_workers(ray, needs)

        def end(log: Path) -> None:
            on_report(by_log[log], report_of(by_log[log], root))

        call_on_ray(ray, works, terms.threads or 1, needs, end)
