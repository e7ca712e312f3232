"""``gsdmsr benchmark soak``: tells whether a long command holds more and more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from rich.table import Table

from gsdmsr_cli.benchmark.soak import Sample, growth, largest, tenths, watch
from gsdmsr_cli.ground import say

SCHEMA = 1


def run(command: Sequence[str], every_s: float) -> None:
    """Run a command and print what it held, a row for each tenth of its time.

    Args:
        command: the arguments of ``gsdmsr``.
        every_s: time between two samples [s].

    Raises:
        GsdmsrError: the command has failed or was too short, or the system is not Linux.
    """
    samples = watch(command, every_s)
    slopes = growth(samples)
    document = {
        "schema": SCHEMA,
        "command": list(command),
        "samples": [asdict(sample) for sample in samples],
        "largest": asdict(largest(samples)),
        "growth_per_hour": asdict(slopes),
    }
    say.result(document, _table(samples, slopes))


def _table(samples: Sequence[Sample], slopes: Sample) -> Table:
    table = Table("minutes", "memory MiB", "shared MiB", "open files", "processes")
    for sample in tenths(samples):
        table.add_row(f"{sample.elapsed_s / 60:.1f}", *_row(sample, ""))
    table.add_section()
    table.add_row("largest", *_row(largest(samples), ""))
    table.add_row("growth per hour", *_row(slopes, "+"))
    return table


def _row(sample: Sample, sign: str) -> list[str]:
    sizes = [f"{size:{sign}.1f}" for size in (sample.memory_mib, sample.shared_mib)]
    return sizes + [f"{count:{sign}.0f}" for count in (sample.files, sample.processes)]
