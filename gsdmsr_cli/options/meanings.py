"""Lists options with their kinds and meanings, as the docstrings of their dataclasses say them."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, get_type_hints

from gsdmsr_cli.options import strict

_ENTRY = re.compile(r"    (?P<names>\w+(?:, \w+)*): (?P<text>.*)")


@dataclass(frozen=True)
class Meaning:
    """One option.

    Attributes:
        key: its name, as in ``--set key=value``.
        default: its value where no preset says otherwise; plain JSON.
        kind: which values are allowed.
        text: what it does.
    """

    key: str
    default: Any
    kind: str
    text: str


def meanings(options: type[Any], prefix: str = "") -> Iterator[Meaning]:
    """Yield every option of a dataclass, and of the dataclasses in it, in their order.

    An option without a line under "Attributes:" has an empty text.
    """
    texts, types = _texts(options), get_type_hints(options)
    for field in dataclasses.fields(options):
        kind = types[field.name]
        if dataclasses.is_dataclass(kind) and isinstance(kind, type):
            yield from meanings(kind, f"{prefix}{field.name}.")
        else:
            default = strict.plain(_default(field))
            allowed = strict.describe_kind(kind)
            yield Meaning(prefix + field.name, default, allowed, texts.get(field.name, ""))


def _default(field: dataclasses.Field[Any]) -> Any:
    if field.default_factory is not dataclasses.MISSING:
        return field.default_factory()
    return field.default


def _texts(options: type[Any]) -> dict[str, str]:
    """Return what the docstring says of each attribute, or those of the classes it extends."""
    texts: dict[str, str] = {}
    for one in reversed(options.__mro__):
        texts |= _texts_of(inspect.cleandoc(one.__doc__ or ""))
    return texts


def _texts_of(docstring: str) -> dict[str, str]:
    """Return what a docstring says of each attribute; several may share a line."""
    _, _, lines = docstring.partition("Attributes:\n")
    texts: dict[str, str] = {}
    names: list[str] = []
    for line in lines.splitlines():
        entry = _ENTRY.fullmatch(line)
        if entry is not None:
            names = entry["names"].split(", ")
            texts |= dict.fromkeys(names, entry["text"])
        elif line.startswith("        "):
            texts |= {name: f"{texts[name]} {line.strip()}" for name in names}
        else:
            break
    return texts
