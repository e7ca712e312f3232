"""Turns plain mappings into frozen dataclasses, strictly, and says where a wrong value stands."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from types import NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Any,
    Literal,
    TypeVar,
    Union,
    cast,
    get_args,
    get_origin,
    get_type_hints,
)

from gsdmsr_cli.ground.errors import UsageError, nearest

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

T = TypeVar("T")

_NOUNS = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "text",
    NoneType: "null",
}


class Located(dict[str, Any]):
    """A mapping that remembers where each of its keys was written.

    Attributes:
        places: of each key, "file:line" or the command-line option that set it.
    """

    def __init__(
        self, items: Mapping[str, Any] | None = None, places: Mapping[str, str] | None = None
    ) -> None:
        super().__init__(items or {})
        self.places = dict(places or {})

    def without(self, *keys: str) -> Located:
        """Return the mapping without ``keys``, places kept."""
        return Located({k: v for k, v in self.items() if k not in keys}, self.places)


class InvalidError(UsageError):
    """A field of a dataclass has the right type but a value outside its range."""

    def __init__(self, key: str, value: object, allowed: str) -> None:
        super().__init__(f"{key} is {_show(value)}; allowed: {allowed}")
        self.key, self.value, self.allowed = key, value, allowed


def require(options: object, key: str, ok: bool, allowed: str) -> None:
    """Check one field in a ``__post_init__``.

    Raises:
        InvalidError: ``ok`` is false; ``build`` adds where the value was written.
    """
    if not ok:
        raise InvalidError(key, getattr(options, key), allowed)


PROGRESS = "a progress from 0 to 1"
"""What is allowed where an option says when something happens in a training."""


def require_progress(options: object, *keys: str) -> None:
    """Check that fields are a progress, in [0, 1].

    Raises:
        InvalidError: one is not.
    """
    for key in keys:
        require(options, key, 0.0 <= getattr(options, key) <= 1.0, PROGRESS)


def require_at_least(options: object, least: int, *keys: str) -> None:
    """Check that fields are ``least`` or more.

    Raises:
        InvalidError: one is not.
    """
    for key in keys:
        require(options, key, getattr(options, key) >= least, f"{least} or more")


def require_positive(options: object, *keys: str) -> None:
    """Check that fields are above 0.

    Raises:
        InvalidError: one is not.
    """
    for key in keys:
        require(options, key, getattr(options, key) > 0, "a number above 0")


def require_rates(options: object, *keys: str) -> None:
    """Check that learning rates, at the start and the end of a training, are above 0.

    Raises:
        InvalidError: one is not.
    """
    for key in keys:
        require(options, key, min(getattr(options, key)) > 0, "[start, end], both above 0")


def build(cls: type[T], mapping: Mapping[str, Any], where: str) -> T:
    """Build the dataclass ``cls``, and those nested in it, from ``mapping``.

    An int is accepted for a float, a bool for neither; lists become tuples; numbers must be finite;
    ``dict[str, Any]`` passes through. ``where`` names the source of keys without a place of
    their own (see ``Located``).

    Raises:
        UsageError: a key is unknown or missing, or a value has the wrong type or range.
    """
    return cast(T, _build(cls, mapping, where, ""))


def dump(options: DataclassInstance) -> dict[str, Any]:
    """Return the inverse of ``build``: nested plain dicts and lists, fit for JSON and YAML."""
    return {
        field.name: plain(getattr(options, field.name)) for field in dataclasses.fields(options)
    }


def plain(value: Any) -> Any:
    """Return the value of an option as plain JSON."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dump(value)
    if isinstance(value, Mapping):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [plain(item) for item in value]
    return value


def _build(cls: Any, mapping: Mapping[str, Any], where: str, prefix: str) -> Any:
    places: Mapping[str, str] = getattr(mapping, "places", {})
    known = {field.name: field for field in dataclasses.fields(cls) if field.init}
    for key in mapping:
        if key not in known:
            place = places.get(key, where)
            raise UsageError(f"{place}: unknown key '{prefix}{key}'; {nearest(key, known)}")
    for key, field in known.items():
        optional = (field.default, field.default_factory) != (dataclasses.MISSING,) * 2
        if key not in mapping and not optional:
            raise UsageError(f"{where}: key '{prefix}{key}' is missing")
    types = get_type_hints(cls)
    values = {
        key: _convert_or_fail(value, types[key], places.get(key, where), prefix + key)
        for key, value in mapping.items()
    }
    try:
        return cls(**values)
    except InvalidError as error:
        place = places.get(error.key, where)
        raise UsageError(f"{place}: {prefix}{error}") from None


class _MismatchError(Exception):
    """The value does not have the type."""


def _convert_or_fail(value: Any, kind: Any, where: str, name: str) -> Any:
    if dataclasses.is_dataclass(kind) and isinstance(value, Mapping):
        return _build(kind, value, where, f"{name}.")
    try:
        return _convert(value, kind)
    except _MismatchError:
        message = f"{where}: {name} is {_show(value)}; allowed: {describe_kind(kind)}"
        raise UsageError(message) from None


def _convert(value: Any, kind: Any) -> Any:
    origin, arguments = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin in (Union, UnionType):
        return _convert_union(value, arguments)
    if origin is tuple:
        return _convert_tuple(value, arguments)
    if origin is Literal:
        # 1 == True in Python, so the type is compared as well
        matches = any(value == a and type(value) is type(a) for a in arguments)
    elif kind is float:
        return _convert_float(value)
    elif kind in _NOUNS:
        matches = type(value) is kind
    elif origin is dict or dataclasses.is_dataclass(kind):
        matches = origin is dict and isinstance(value, Mapping)
    else:
        raise TypeError(f"{kind} is not a type that options may have")
    if not matches:
        raise _MismatchError
    return value


def _convert_float(value: Any) -> float:
    if type(value) not in (int, float):
        raise _MismatchError
    try:
        number = float(value)
    except OverflowError:
        raise _MismatchError from None
    if not math.isfinite(number):
        raise _MismatchError
    return number


def _convert_union(value: Any, kinds: tuple[Any, ...]) -> Any:
    for kind in kinds:
        try:
            return _convert(value, kind)
        except _MismatchError:
            continue
    raise _MismatchError


def _convert_tuple(value: Any, kinds: tuple[Any, ...]) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise _MismatchError
    if kinds[-1] is Ellipsis:
        kinds = kinds[:1] * len(value)
    if len(value) != len(kinds):
        raise _MismatchError
    return tuple(_convert(item, kind) for item, kind in zip(value, kinds, strict=True))


def describe_kind(kind: Any) -> str:
    """Return which values a type of options allows, such as "a whole number or null"."""
    origin, arguments = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return " or ".join(describe_kind(argument) for argument in arguments)
    if origin is Literal:
        return " or ".join(repr(argument) for argument in arguments)
    if origin is tuple and arguments[-1] is Ellipsis:
        return f"a list, each item {describe_kind(arguments[0])}"
    if origin is tuple:
        return f"a list of {len(arguments)} items: {', '.join(map(describe_kind, arguments))}"
    return _NOUNS.get(kind, "a mapping")


def _show(value: object) -> str:
    """Return the value as it would be written in a file, shortened to fit a line."""
    text = json.dumps(plain(value), default=str, ensure_ascii=False)
    return text if len(text) <= 60 else f"{text[:57]}..."
