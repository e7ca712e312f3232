"""strict: what is accepted, what is refused, and that the message says where."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from gsdmsr_cli.ground.errors import UsageError
from gsdmsr_cli.options import strict


@dataclass(frozen=True)
class Inner:
    size: int = 1
    rate: tuple[float, float] = (1.0, 2.0)

    def __post_init__(self) -> None:
        strict.require(self, "size", self.size >= 1, "1 or more")


@dataclass(frozen=True)
class Outer:
    needed: str
    flag: bool = False
    weight: float = 0.5
    budget: str | None = None
    colour: Literal["white", "black"] = "white"
    degree: Literal[0, 1] = 0
    moments: tuple[float, ...] = ()
    inner: Inner = field(default_factory=Inner)
    extra: dict[str, Any] = field(default_factory=dict)


def test_all_kinds_of_values_are_built() -> None:
    mapping = {
        "needed": "x",
        "flag": True,
        "weight": 2,
        "budget": "8m",
        "colour": "black",
        "degree": 1,
        "moments": [0, 0.5, 1],
        "inner": {"size": 3, "rate": [1, 2.5]},
        "extra": {"name": "any", "list": [1, {"a": None}]},
    }
    built = strict.build(Outer, mapping, "here")
    assert built == Outer(
        "x", True, 2.0, "8m", "black", 1, (0.0, 0.5, 1.0), Inner(3, (1.0, 2.5)), mapping["extra"]
    )
    assert type(built.weight) is float
    assert all(type(moment) is float for moment in built.moments)


@pytest.mark.parametrize(
    ("key", "value", "found", "allowed"),
    [
        ("needed", 3, "3", "text"),
        ("flag", 1, "1", "true or false"),
        ("weight", True, "true", "a number"),
        ("weight", "1", '"1"', "a number"),
        ("weight", float("nan"), "NaN", "a number"),
        ("weight", 10**400, "1000", "a number"),
        ("budget", 8, "8", "text or null"),
        ("colour", "grey", '"grey"', "'white' or 'black'"),
        ("colour", ["white"], '["white"]', "'white' or 'black'"),
        ("degree", True, "true", "0 or 1"),
        ("moments", [0.1, "b"], '[0.1, "b"]', "a list, each item a number"),
        ("moments", 0.1, "0.1", "a list, each item a number"),
        ("inner", 3, "3", "a mapping"),
        ("extra", [], "[]", "a mapping"),
    ],
)
def test_a_wrong_type_names_place_key_value_and_what_is_allowed(
    key: str, value: object, found: str, allowed: str
) -> None:
    mapping = strict.Located({"needed": "x"} | {key: value}, {key: "file.yaml:7"})
    with pytest.raises(UsageError) as caught:
        strict.build(Outer, mapping, "elsewhere")
    message = str(caught.value)
    assert message.startswith(f"file.yaml:7: {key} is {found}")
    assert message.endswith(f"; allowed: {allowed}")
    assert "\n" not in message
    assert len(message) < 200


@pytest.mark.parametrize("rate", [[1.0], [1.0, 2.0, 3.0], [], [True, 2.0], [None, 1.0]])
def test_a_pair_has_two_numbers(rate: list[object]) -> None:
    with pytest.raises(UsageError, match=r"here: inner\.rate is .*a list of 2 items: a number"):
        strict.build(Outer, {"needed": "x", "inner": {"rate": rate}}, "here")


def test_an_unknown_key_names_the_nearest_and_its_line() -> None:
    inner = strict.Located({"sise": 3}, {"sise": "file.yaml:4"})
    with pytest.raises(UsageError) as caught:
        strict.build(Outer, {"needed": "x", "inner": inner}, "here")
    assert str(caught.value) == "file.yaml:4: unknown key 'inner.sise'; did you mean 'size'?"


def test_a_missing_key_is_named() -> None:
    with pytest.raises(UsageError, match="here: key 'needed' is missing"):
        strict.build(Outer, {}, "here")


def test_a_value_out_of_range_keeps_its_place() -> None:
    inner = strict.Located({"size": 0}, {"size": "file.yaml:4"})
    with pytest.raises(UsageError) as caught:
        strict.build(Outer, {"needed": "x", "inner": inner}, "here")
    assert str(caught.value) == "file.yaml:4: inner.size is 0; allowed: 1 or more"


def test_a_long_value_is_shortened() -> None:
    with pytest.raises(UsageError) as caught:
        strict.build(Outer, {"needed": list(range(1000))}, "here")
    assert len(str(caught.value)) < 120


def test_without_keeps_places_and_leaves_the_original() -> None:
    whole = strict.Located({"name": "a", "size": 2}, {"name": "f:1", "size": "f:2"})
    rest = whole.without("name")
    assert rest == {"size": 2}
    assert rest.places["size"] == "f:2"
    assert whole == {"name": "a", "size": 2}


NUMBERS = st.floats(allow_nan=False, allow_infinity=False)


@given(
    st.builds(
        Outer,
        needed=st.text(),
        flag=st.booleans(),
        weight=NUMBERS,
        budget=st.none() | st.text(),
        colour=st.sampled_from(["white", "black"]),
        degree=st.sampled_from([0, 1]),
        moments=st.lists(NUMBERS).map(tuple),
        inner=st.builds(Inner, size=st.integers(1, 99), rate=st.tuples(NUMBERS, NUMBERS)),
        extra=st.dictionaries(st.text(), st.none() | st.integers() | st.lists(st.integers())),
    )
)
def test_dump_then_build_through_json_is_the_identity(options: Outer) -> None:
    text = json.dumps(strict.dump(options), allow_nan=False)
    assert strict.build(Outer, json.loads(text), "here") == options
