"""Reads presets: YAML files that inherit with ``base:`` and are overridden with ``--set``."""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, cast

import yaml

from gsdmsr_cli.ground import say
from gsdmsr_cli.ground.errors import UsageError, nearest
from gsdmsr_cli.options.renamed import with_present_names
from gsdmsr_cli.options.strict import Located

Place = Callable[[int], str]
"""Names where line n (from 1) of a text stands."""


_ABOUT = "base", "description"
"""Keys of a preset that are no options: what it inherits from, and what it is for."""


class _Loader(yaml.SafeLoader):  # type: ignore[misc]
    """Safe YAML with the scalars of YAML 1.2: 1e-3 is a number; on, 1:30 and dates are text."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012  (PyYAML's own class attribute)

    def compose_node(self, parent: Any, index: Any) -> Any:
        """Refuse aliases, which could make a file endless; ``base:`` shares options instead."""
        if self.check_event(yaml.AliasEvent):
            mark = self.peek_event().start_mark
            raise yaml.composer.ComposerError(None, None, "aliases (*name) are not allowed", mark)
        return super().compose_node(parent, index)


_KINDS = "null", "bool", "int", "float", "str", "seq", "map"
_TAGS = {f"tag:yaml.org,2002:{kind}" for kind in _KINDS}
"""Kinds of values that options have; a file may name others."""

_FLOAT = r"[-+]?(\.[0-9]+|[0-9]+\.[0-9]*)([eE][-+]?[0-9]+)?|[-+]?[0-9]+[eE][-+]?[0-9]+"
for _tag, _pattern, _first in [
    ("null", r"~|null|Null|NULL|", ["~", "n", "N", ""]),
    ("bool", r"true|True|TRUE|false|False|FALSE", list("tTfF")),
    ("int", r"[-+]?(0|[1-9][0-9]*)", list("-+0123456789")),
    ("float", rf"{_FLOAT}|[-+]?\.inf|\.nan", list("-+.0123456789")),
]:
    _Loader.add_implicit_resolver(
        f"tag:yaml.org,2002:{_tag}", re.compile(f"^(?:{_pattern})$"), _first
    )


def resolve(name: str | None, config: Path | None, overrides: Sequence[str]) -> Located:
    """Return the mapping of preset ``name``, then file ``config``, then ``a.b=value`` overrides.

    Without ``name`` the config's ``base:`` is the preset, and without that ``default``. Names of
    earlier versions are read, with a hint on stderr.

    Raises:
        UsageError: a preset does not exist or inherits from itself; a file cannot be read or is not
            YAML; an override has no '='; ``name`` contradicts the config's ``base:``.
    """
    own = read(config) if config else Located()
    preset = _named(name, own) or "default"
    given = [own.without(*_ABOUT), read_overrides(overrides)]
    asked = [with_present_names(mapping, _hint) for mapping in given]
    return functools.reduce(_merge, [*_chain(preset), *asked])


def named_preset(name: str | None, config: Path | None) -> str | None:
    """Return ``name``, else the ``base:`` of ``config``, else None.

    Raises:
        UsageError: the file cannot be read or is not YAML; ``name`` contradicts its ``base:``.
    """
    return _named(name, read(config) if config else Located())


def _named(name: str | None, own: Located) -> str | None:
    base = _base(own)
    if name and base and name != base:
        raise UsageError(
            f"{own.places['base']}: base '{base}' contradicts --preset {name}; drop one"
        )
    return name or base


@functools.cache  # a command may read its options several times, and says this once
def _hint(text: str) -> None:
    say.note(f"hint: {text}")


def preset_folder() -> Path:
    """Return the folder of presets: inside the installed package, or beside it in a checkout."""
    installed = Path(str(resources.files("gsdmsr_cli"))) / "presets"
    return installed if installed.is_dir() else installed.parent.parent / "presets"


def preset_names() -> list[str]:
    """Return the names of all presets, sorted."""
    return sorted(path.stem for path in preset_folder().glob("*.yaml"))


def preset_chain(name: str) -> list[str]:
    """Return the preset and those that it inherits from, the most basic last.

    Raises:
        UsageError: a preset does not exist or inherits from itself.
    """
    _chain(name)  # refuses circles
    base = _base(_preset(name))
    return [name, *(preset_chain(base) if base else [])]


def purpose(name: str) -> str:
    """Return what a preset is for, in one line.

    Raises:
        UsageError: there is no such preset.
    """
    return str(_preset(name).get("description", ""))


def read(path: Path) -> Located:
    """Read one YAML file that holds a mapping; an empty file is an empty mapping.

    Raises:
        UsageError: the file cannot be read, is not YAML or not a mapping.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
    except OSError as error:
        raise UsageError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise UsageError(f"{path}: is not UTF-8 text") from None
    value = _parse(text, lambda line: f"{path}:{line}", str(path))
    if value is None:
        return Located()
    if not isinstance(value, Located):
        raise UsageError(f"{path}: holds no mapping; write lines such as 'training: {{steps: 9}}'")
    return value


def _chain(name: str, above: tuple[str, ...] = ()) -> list[Located]:
    """Return the preset and all it inherits from, the most basic first."""
    if name in above:
        circle = " -> ".join([*above, name])
        raise UsageError(f"preset '{name}' inherits from itself: {circle}")
    own = _preset(name)
    base = _base(own)
    below = _chain(base, (*above, name)) if base else []
    return [*below, own.without(*_ABOUT)]


def _preset(name: str) -> Located:
    known = preset_names()
    if name not in known:
        raise UsageError(f"unknown preset '{name}'; {nearest(name, known)}")
    return read(preset_folder() / f"{name}.yaml")


def _base(mapping: Located) -> str | None:
    base = mapping.get("base")
    if base is not None and not isinstance(base, str):
        raise UsageError(f"{mapping.places['base']}: base is not the name of a preset")
    return base


def read_overrides(overrides: Sequence[str]) -> Located:
    """Return the texts "a.b=value" of ``--set`` as one mapping, whatever order they come in.

    Raises:
        UsageError: a text has another form, or gives a key both a value and keys below it.
    """
    return functools.reduce(_merge, map(_branch, overrides), Located())


def _branch(override: str) -> Located:
    """Return "a.b=value" as nested mappings."""
    keys, equals, text = override.partition("=")
    path = keys.split(".")
    if not equals or not all(path):
        raise UsageError(f"--set {override}: allowed: a.b=value, as in training.steps=500")
    place = f"--set {override}"
    branch = _parse(text, lambda _: place, place)
    for key in reversed(path):
        branch = Located({key: branch}, {key: place})
    return cast(Located, branch)


def _merge(base: Located, over: Located) -> Located:
    """Return ``base`` with the keys of ``over``, nested mappings merged.

    A mapping that carries another ``name`` replaces: the options of a plug-in are its own.

    Raises:
        UsageError: ``base`` has a single value where ``over`` has a mapping.
    """
    merged = Located(base, base.places | over.places)
    for key, value in over.items():
        old = base.get(key)
        if isinstance(old, Located) and isinstance(value, Located) and not _renames(old, value):
            value = _merge(old, value)
        elif key in base and isinstance(value, Located) and not isinstance(old, Located):
            raise UsageError(f"{base.places[key]}: {key} is {old!r}; allowed: a mapping")
        merged[key] = value
    return merged


def _renames(old: Located, new: Located) -> bool:
    return "name" in old and "name" in new and old["name"] != new["name"]


def _parse(text: str, place: Place, source: str) -> Any:
    """Return the value of a YAML text, every mapping Located."""
    loader = None
    try:
        loader = _Loader(text)
        node = loader.get_single_node()
        return None if node is None else _value(loader, node, place)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        where = place(mark.line + 1) if mark else source
        raise UsageError(f"{where}: is not YAML: {error.problem or error.context}") from None
    except yaml.reader.ReaderError as error:
        raise UsageError(f"{source}: is not YAML: {error.reason}") from None
    except RecursionError:
        raise UsageError(f"{source}: is nested too deeply") from None
    finally:
        if loader is not None:
            loader.dispose()


def _value(loader: _Loader, node: yaml.Node, place: Place) -> Any:
    if node.tag not in _TAGS:
        where = place(node.start_mark.line + 1)
        raise UsageError(f"{where}: the tag '{node.tag:.60}' is not allowed; drop it")
    if isinstance(node, yaml.SequenceNode):
        return [_value(loader, item, place) for item in node.value]
    if isinstance(node, yaml.MappingNode):
        return _mapping(loader, node, place)
    try:
        return loader.construct_object(node)
    except (ValueError, LookupError) as error:  # as of !!bool x, and of very long numbers
        where = place(node.start_mark.line + 1)
        raise UsageError(f"{where}: '{node.value[:40]}' cannot be read: {error}") from None


def _mapping(loader: _Loader, node: yaml.MappingNode, place: Place) -> Located:
    mapping = Located()
    for key_node, value_node in node.value:
        where = place(key_node.start_mark.line + 1)
        key = _value(loader, key_node, place)
        if not isinstance(key, str):
            raise UsageError(f"{where}: key {key!r} is not a name")
        if key in mapping:
            raise UsageError(
                f"{where}: key '{key}' stands twice; the first is at {mapping.places[key]}"
            )
        mapping[key] = _value(loader, value_node, place)
        mapping.places[key] = where
    return mapping
