"""gsdmsr weights: lists which weights of LPIPS are installed, and downloads missing ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.markup import escape
from rich.table import Table

from gsdmsr_cli.commands._progress import progress_bar
from gsdmsr_cli.evaluation.lpips import NETS, find_weights, hub_folder, load_lpips, search_folders
from gsdmsr_cli.evaluation.metrics import Missing
from gsdmsr_cli.evaluation.weights import Fetched, fetch, source
from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import DataError, UsageError, nearest


def run(
    nets: Sequence[str] = (),
    to: Path | None = None,
    folder: Path | None = None,
) -> None:
    """Fetch what is missing of the networks named, then print what is there.

    Args:
        nets: networks to fetch; nothing is fetched for others.
        to: folder to fetch into, torch's own if None.
        folder: a folder that is searched before the usual ones.

    Raises:
        UsageError: there is no such network.
        DataError: a file cannot be fetched or written, or ``folder`` is not a folder.
    """
    for net in nets:
        if net not in NETS:
            raise UsageError(f"--fetch {net}: no such network; {nearest(net, NETS)}")
    for net in dict.fromkeys(nets):
        for kind, found in find_weights(net, folder).items():
            if isinstance(found, Missing):
                _print_fetched(_fetch(net, kind, to or hub_folder()), source(net, kind).url)
    report = examine(folder or (to if nets else None))
    say.result(report, _table(report), f"looked in: {', '.join(report['searched'])}")


def examine(folder: Path | None = None) -> dict[str, Any]:
    """Return by network where its files lie, and why LPIPS cannot be computed with them or null.

    Raises:
        DataError: ``folder`` is not a folder.
    """
    nets = {}
    for net in NETS:
        files = find_weights(net, folder).items()
        places = {kind: None if isinstance(f, Missing) else str(f) for kind, f in files}
        nets[f"lpips_{net}"] = {**places, "reason": _reason(net, folder)}
    return {"nets": nets, "searched": [str(path) for path in search_folders(folder)]}


def _reason(net: str, folder: Path | None) -> str | None:
    try:
        found = load_lpips(net, folder)
    except DataError as error:
        return str(error)
    return found.reason if isinstance(found, Missing) else None


def _fetch(net: str, kind: str, to: Path) -> Fetched:
    with progress_bar(f"fetching {kind} of {net}") as on_progress:
        return fetch(source(net, kind), to, on_progress)


def _print_fetched(fetched: Fetched, url: str) -> None:
    say.note(f"fetched {url}: {fetched.size} bytes, SHA-256 {fetched.sha256}, to {fetched.path}")


def _table(report: dict[str, Any]) -> Table:
    table = Table()
    for head in ("metric", "trunk", "linear layers", "can be computed"):
        table.add_column(head, overflow="fold")
    for name, entry in report["nets"].items():
        places = (escape(entry[kind] or "missing") for kind in ("trunk", "linear"))
        net, reason = name.removeprefix("lpips_"), entry["reason"]
        missing = None in (entry["trunk"], entry["linear"])
        remedy = f"no; gsdmsr weights --fetch {net}" if missing else f"no: {reason}"
        table.add_row(name, *places, "yes" if reason is None else escape(remedy))
    return table
