"""gsdmsr presets: lists presets, and all options of one with their meanings."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from rich.markup import escape
from rich.table import Table

from gsdmsr_cli.ground import plugins, say
from gsdmsr_cli.options import preset_files, strict
from gsdmsr_cli.options.meanings import Meaning, meanings
from gsdmsr_cli.options.preset import Preset, load_preset

MOTIONS = "gsdmsr_cli.model.motion"
"""The package whose plug-ins have the options under ``motion``."""

WIDTH = 120
"""Columns of text for the options, whose meanings would be folded to slivers in 80."""


def run(name: str | None) -> None:
    """Print all presets, or the options of one.

    Raises:
        UsageError: there is no such preset.
    """
    if name is None:
        listed = [_about(preset) for preset in preset_files.preset_names()]
        say.result({"presets": listed}, _list(listed))
        return
    about, options = _about(name), list(describe_options(load_preset(name, None, [])))
    first = f"{name}: {about['description']}"
    based = f"based on {', '.join(about['base'])}" if about["base"] else "based on nothing"
    last = "bold: other than the default; set one with gsdmsr train --set key=value"
    document = about | {"options": options}
    say.result(document, first, based, _options(options), last, width=WIDTH)


def describe_options(preset: Preset) -> Iterator[dict[str, Any]]:
    """Yield each option that ``--set`` takes: key, value, default, kind and meaning."""
    stored = strict.dump(preset)
    for meaning in meanings(Preset):
        topic, _, key = meaning.key.rpartition(".")
        value = stored[topic][key] if topic else stored[key]
        if meaning.key == "motion":
            yield from _motion_options(preset)
        else:
            yield _entry(meaning, value)


def _motion_options(preset: Preset) -> Iterator[dict[str, Any]]:
    name = str(preset.motion["name"])
    default = str(Preset().motion["name"])
    text = "the motion, whose own options follow, see gsdmsr_cli/model/motion"
    known = strict.dump(preset)["motion"]
    kind = " or ".join(f"'{other}'" for other in plugins.names(MOTIONS))
    yield _entry(Meaning("motion.name", default, kind, text), name)
    module: Any = plugins.load(MOTIONS, name)
    for meaning in meanings(module.Options, "motion."):
        yield _entry(meaning, known.get(meaning.key.removeprefix("motion."), meaning.default))


def _entry(meaning: Meaning, value: Any) -> dict[str, Any]:
    about = asdict(meaning)
    text = about.pop("text")
    return {"key": about.pop("key"), "value": value, **about, "meaning": text}


def _about(name: str) -> dict[str, Any]:
    _, *base = preset_files.preset_chain(name)
    return {"name": name, "description": preset_files.purpose(name), "base": base}


def _list(listed: list[dict[str, Any]]) -> Table:
    table = Table("preset", "for", "based on")
    for about in listed:
        table.add_row(about["name"], escape(about["description"]), ", ".join(about["base"]))
    return table


def _options(options: list[dict[str, Any]]) -> Table:
    table = Table()
    for head, width in (("key", 28), ("value", 16), ("default", 16), ("meaning", None)):
        table.add_column(head, max_width=width, overflow="fold")
    topic = ""
    for entry in options:
        own, _, _ = entry["key"].partition(".")
        if topic and own != topic:
            table.add_section()
        topic = own
        value, default = (escape(_shown(entry[key])) for key in ("value", "default"))
        bold = f"[bold]{value}[/]" if entry["value"] != entry["default"] else value
        table.add_row(entry["key"], bold, default, escape(f"{entry['meaning']} ({entry['kind']})"))
    return table


def _shown(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value)
