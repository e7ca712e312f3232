"""Options are told with what they mean, from the docstrings of their dataclasses alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import pytest

from gsdmsr_cli import exports
from gsdmsr_cli.ground import plugins
from gsdmsr_cli.options.meanings import Meaning, meanings
from gsdmsr_cli.options.preset import Preset


@dataclass(frozen=True)
class Inner:
    """Options within others.

    Attributes:
        width, height: sides of it,
            in pixels.
        kind: "a" or
            "b".

    What follows is not of an option: this.
    """

    width: int = 3
    height: int | None = None
    kind: Literal["a", "b"] = "a"
    untold: float = 0.5


@dataclass(frozen=True)
class Outer:
    """Options of which some are others.

    Attributes:
        rates: two of them.
    """

    rates: tuple[float, float] = (1.0, 0.1)
    inner: Inner = field(default_factory=Inner)


def test_every_option_is_listed_with_its_kind_default_and_meaning() -> None:
    assert list(meanings(Outer)) == [
        Meaning("rates", [1.0, 0.1], "a list of 2 items: a number, a number", "two of them."),
        Meaning("inner.width", 3, "a whole number", "sides of it, in pixels."),
        Meaning("inner.height", None, "a whole number or null", "sides of it, in pixels."),
        Meaning("inner.kind", "a", "'a' or 'b'", '"a" or "b".'),
        Meaning("inner.untold", 0.5, "a number", ""),
    ]


@dataclass(frozen=True)
class Extended(Inner):
    """Settings that extend others.

    Attributes:
        width: another width.
        depth: how deep it is.
    """

    depth: int = 1


def test_what_an_extended_class_says_of_its_options_holds_unless_it_is_said_anew() -> None:
    texts = {meaning.key: meaning.text for meaning in meanings(Extended)}
    assert texts["width"] == "another width." and texts["depth"] == "how deep it is."
    assert texts["height"] == "sides of it, in pixels."


def all_options() -> list[Any]:
    packages = (
        "gsdmsr_cli.model.motion", "gsdmsr_cli.model.layers", "gsdmsr_cli.training.losses",
        "gsdmsr_cli.training.population", exports.__name__,
    )  # fmt: skip
    modules = [plugins.load(package, n) for package in packages for n in plugins.names(package)]
    return [Preset, *(module.Options for module in modules if hasattr(module, "Options"))]


@pytest.mark.parametrize("options", all_options(), ids=lambda o: f"{o.__module__}.{o.__name__}")
def test_every_option_there_is_has_a_meaning(options: Any) -> None:
    for meaning in meanings(options):
        assert len(meaning.text) > 5, meaning.key
        assert meaning.kind, meaning.key
