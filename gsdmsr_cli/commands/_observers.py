"""Hands the reports of a training to TensorBoard and Weights & Biases, if that is asked for."""

from __future__ import annotations

import importlib
import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from types import ModuleType
from typing import Any

from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.options import strict
from gsdmsr_cli.runs.run import Run
from gsdmsr_cli.training.loop import Report

EVENTS = "tensorboard"
"""Folder in the run folder for the files of TensorBoard."""

_EVENT_FILES = "events.out.tfevents.*"

OnReport = Callable[[Report], None]


@dataclass(frozen=True)
class Wanted:
    """What is to see the reports.

    Attributes:
        tensorboard: the module that writes for TensorBoard, or None.
        wandb: the module of Weights & Biases, or None.
        project: of Weights & Biases.
    """

    tensorboard: ModuleType | None
    wandb: ModuleType | None
    project: str


def find_observers(tensorboard: bool, project: str | None) -> Wanted:
    """Import what is asked for, and nothing else.

    Raises:
        UsageError: it is not installed.
    """
    return Wanted(
        _load("tensorboardX", "--tensorboard", "tensorboard") if tensorboard else None,
        _load("wandb", "--wandb", "wandb") if project is not None else None,
        project or "",
    )


def _load(module: str, option: str, extra: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise UsageError(
            f"{option} needs {module}, which cannot be imported ({error}); "
            f"pip install 'gsdmsr[{extra}]'"
        ) from error


@contextmanager
def observing(wanted: Wanted, run: Run, step: int) -> Iterator[OnReport]:
    """Yield what hands on a report; one that fails is left out with a warning, training goes on.

    Args:
        wanted: what is to see the reports.
        run: the run folder.
        step: that the training begins at, above 0 if it is resumed.
    """
    observers: dict[str, tuple[OnReport, Callable[[], object]]] = {}
    for name, module, start in (
        ("TensorBoard", wanted.tensorboard, _tensorboard),
        ("Weights & Biases", wanted.wandb, _wandb),
    ):
        if module is not None:
            with _harmless(name):
                observers[name] = start(module, wanted, run, step)

    def hand_on(report: Report) -> None:
        for name, (show, _) in list(observers.items()):
            with _harmless(name, partial(observers.pop, name)):
                show(report)

    try:
        yield hand_on
    finally:
        for name, (_, close) in observers.items():
            with _harmless(name):
                close()


@contextmanager
def _harmless(name: str, otherwise: Callable[[], object] = lambda: None) -> Iterator[None]:
    try:
        yield
    except Exception as error:  # whatever others raise: it must not end a training
        say.warn(f"{name} is left out from here on: {type(error).__name__}: {error}")
        otherwise()


def _tensorboard(
    module: Any, _wanted: Wanted, run: Run, step: int
) -> tuple[OnReport, Callable[[], object]]:
    folder = run.root / EVENTS
    if step == 0:
        for earlier in folder.glob(_EVENT_FILES):  # of the run that was here before
            earlier.unlink()
    writer = module.SummaryWriter(str(folder), purge_step=step + 1 if step else None)
    writer.add_text("options", f"```\n{json.dumps(strict.dump(run.preset), indent=2)}\n```", step)

    def show(report: Report) -> None:
        for name, value in _numbers(report).items():
            writer.add_scalar(name, value, report.step)

    return show, writer.close


def _wandb(
    module: Any, wanted: Wanted, run: Run, _step: int
) -> tuple[OnReport, Callable[[], object]]:
    begun = module.init(
        project=wanted.project,
        name=run.root.resolve().name,
        dir=str(run.root),
        config=strict.dump(run.preset),
    )
    return (lambda report: begun.log(_numbers(report), step=report.step)), begun.finish


def _numbers(report: Report) -> dict[str, float]:
    """Return the numbers of a report; those of its timings have names with a slash."""
    entry: Mapping[str, Any] = report.entry()
    timings = {f"timings/{name}": seconds for name, seconds in entry["timings"].items()}
    return {
        name: float(value)
        for name, value in (*entry.items(), *timings.items())
        if isinstance(value, int | float) and name != "step"
    }
