"""Writes a trained model as files for other programs: one module of this package per file format.

An exporter is a module with ``Options``, a frozen dataclass of its settings, and the two functions
of the protocol ``Exporter``. Exporters never import one another; what they share lies in files with
a leading underscore.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, cast

from gsdmsr_cli.exports._asked import Asked, taken_apart
from gsdmsr_cli.exports._facts import Facts
from gsdmsr_cli.ground import plugins, say
from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.ground.progress import OnProgress
from gsdmsr_cli.options import strict

if TYPE_CHECKING:  # Model brings torch, which --help must not wait for
    from gsdmsr_cli.exports._source import Source
    from gsdmsr_cli.model.model import Model


class Exporter(Protocol):
    """What a module of this package offers beside its ``Options``.

    A module whose format prescribes axes names them in ``AXES``, see ``Asked.axes``. One that
    writes the model itself in place of its splats says ``WHOLE = True``, and takes none of
    ``Asked``. One that has rotations and scales of its own making says ``BAKES = True``.
    """

    Options: type[Any]

    def lost(self, source: Source, options: Any) -> list[str]:
        """Return what the file cannot carry of the model with these options, a phrase for each.

        What the user leaves out by an option is not lost.
        """

    def write(
        self, source: Source, facts: Facts, options: Any, out: Path, on_progress: OnProgress
    ) -> list[Path]:
        """Write the model to the file or folder ``out`` and return the files written.

        Raises:
            UsageError: ``out`` has not the form that the format needs.
            DataError: a splat holds NaN or infinity, or a file cannot be written.
        """


def format_names() -> list[str]:
    """Return the names of all formats as users type them, sorted."""
    return [name.replace("_", "-") for name in plugins.names(__name__)]


@dataclass(frozen=True)
class Written:
    """What has been exported.

    Attributes:
        files: that were written.
        splats: in a file; in the one that has most.
        lost: what they lack of the model, a phrase for each.
        details: what the format has to tell of them, plain JSON.
    """

    files: list[Path]
    splats: int
    lost: list[str]
    details: dict[str, Any]


def export(
    format_: str,
    model: Model,
    facts: Facts,
    settings: strict.Located,
    out: Path,
    on_progress: OnProgress = lambda done, total: None,
) -> Written:
    """Write the model in a format.

    Args:
        format_: one of ``format_names()``.
        model: what is written.
        facts: of its scene.
        settings: the options of every export (``Asked``) and the format's, and where each was
            given.
        out: file or folder to write.
        on_progress: called after every file.

    Raises:
        UsageError: there is no such format, an option is unknown or out of range, or the format
            cannot carry the whole model and may not be lossy.
        DataError: a splat holds NaN or infinity, or a file cannot be written.
    """
    from gsdmsr_cli.exports._source import Source  # brings torch

    exporter = cast(Exporter, plugins.load(__name__, format_.replace("-", "_")))
    common, own = taken_apart(settings)
    whole = getattr(exporter, "WHOLE", False)
    if whole and not model.steady:
        raise UsageError(
            f"--format {format_} holds one model, and this run has those of several segments of "
            "time; export the runs in its folder segments one by one"
        )
    options = _read_options(format_, exporter.Options, settings if whole else own)
    asked = strict.build(Asked, common, f"--format {format_}")
    axes = asked.axes or getattr(exporter, "AXES", "scene")
    source = Source(model, replace(asked, axes=axes), facts)
    lost = [] if whole else _lost(format_, exporter, source, options)
    files = exporter.write(source, facts, options, out, on_progress)
    splats = max(source.counts, default=len(model.splats))
    return Written(files, splats, lost, source.details)


def _lost(format_: str, exporter: Exporter, source: Source, options: Any) -> list[str]:
    """Return what the file will lack; raise UsageError if that was not agreed to or is too much."""
    never = source.impossible_at(0.0, getattr(exporter, "BAKES", False))
    lost = never if source.model.needs_camera else never + exporter.lost(source, options)
    what = f"--format {format_} cannot carry {' nor '.join(lost)} of this run"
    if never or (lost and not source.asked.lossy):
        others = f"choose another format of {', '.join(format_names())}"
        raise UsageError(f"{what}; {others}" + ("" if never else ", or leave it out with --lossy"))
    if lost:
        say.warn(f"{what}: left out")
    return lost


def _read_options(format_: str, cls: type[Any], settings: strict.Located) -> Any:
    """Return the settings as a format's ``Options``; raise UsageError unless it takes them."""
    taken = [field.name for field in dataclasses.fields(cls)]
    for key in settings:
        if key not in taken:
            place = settings.places.get(key, key)
            raise UsageError(
                f"{place} is not for --format {format_}, which takes "
                f"{', '.join(taken) or 'no options'}; drop it"
            )
    return strict.build(cls, settings, f"--format {format_}")
