"""``gsdmsr benchmark resume``: kills trainings at random moments and compares their ends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from rich.table import Table

from gsdmsr_cli.benchmark.kills import Kill, survive
from gsdmsr_cli.formats import read_scene
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import GsdmsrError
from gsdmsr_cli.options.preset import load_preset

SCHEMA = 1


def run(
    scene: Path,
    out: Path,
    preset: str,
    overrides: Sequence[str],
    kills: int,
    seed: int,
    ranks: int,
) -> None:
    """Train once undisturbed and ``kills`` times with a SIGKILL, and print what came of it.

    With several ranks one of them gets the SIGKILL, and torchrun goes on by itself.

    Raises:
        UsageError: a preset or an option does not exist.
        DataError: the scene or the folder cannot be used.
        GsdmsrError: a training has failed, or a killed one has ended otherwise than the first.
    """
    read_scene(scene)
    load_preset(preset, None, overrides)
    options = ["--data", str(scene), "--preset", preset]
    options += [part for override in overrides for part in ("--set", override)]

    def on_progress(kill: Kill) -> None:
        result = "identical" if kill.identical else "DIFFERENT"
        say.note(f"killed after {kill.after_s:.1f} s, {_source(kill, ranks)}: {result}")

    found = survive(options, out, kills, seed, on_progress, ranks)
    document = {"schema": SCHEMA, "kills": [asdict(kill) for kill in found]}
    say.result(document, _table(found, ranks))
    different = sum(not kill.identical for kill in found)
    if different:
        raise GsdmsrError(
            f"{different} of {kills} killed trainings have ended otherwise than the undisturbed "
            f"one; all are left in {out}"
        )


def _source(kill: Kill, ranks: int) -> str:
    if kill.step is None:
        return "begun anew" if ranks == 1 else "it had ended"
    return f"resumed from step {kill.step}"


def _table(found: Sequence[Kill], ranks: int) -> Table:
    table = Table("killed after", "then", "end")
    for kill in found:
        end = "identical" if kill.identical else "different"
        table.add_row(f"{kill.after_s:.1f} s", _source(kill, ranks), end)
    return table
