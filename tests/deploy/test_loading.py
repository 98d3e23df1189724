"""Dataclasses from plain values: types, limits, and the dotted name of what does not fit."""

import json
from dataclasses import asdict, dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from deploy.loading import WrongValue, between, limited_field, load_dataclass, one_of, require_valid


@dataclass(frozen=True)
class Inner:
    rate: float = limited_field(between(0, 1000, " Hz"), 5.0)
    kind: str = limited_field(one_of("a", "b"), "a")


@dataclass(frozen=True)
class Outer:
    name: str
    inner: Inner
    many: list[Inner]
    shape: tuple[int, ...] = ()
    pair: tuple[int, str] = (1, "x")
    counts: dict[str, int] | None = None
    flag: bool = False

    def __post_init__(self):
        require_valid(self)
        if len(self.shape) > 3:
            raise WrongValue("shape", "has too many sides")


PLAIN = {"name": "n", "inner": {"rate": 1}, "many": [{"kind": "b"}], "shape": [2, 3]}


def test_defaults_nested_values_and_whole_numbers():
    loaded = load_dataclass(Outer, PLAIN)
    assert loaded == Outer("n", Inner(1.0), [Inner(kind="b")], (2, 3))
    assert load_dataclass(Outer, json.loads(json.dumps(asdict(loaded)))) == loaded


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"inner": {"rate": 2000}}, "'inner.rate' must be from 0 to 1000 Hz, not 2000.0"),
        ({"inner": {"rate": float("nan")}}, "'inner.rate' must be a finite number, not nan"),
        ({"inner": {"rate": True}}, "'inner.rate' must be a finite number, not True"),
        ({"many": [{}, {"kind": "c"}]}, "'many[1].kind' must be one of a, b, not 'c'"),
        ({"many": {}}, "'many' must be a list, such as [{}], not {}"),
        ({"shape": [1, 2.5]}, "'shape[1]' must be a whole number, not 2.5"),
        ({"shape": [1, 1, 1, 1]}, "'shape' has too many sides"),
        ({"pair": [1]}, "'pair' must be a list of 2, not [1]"),
        ({"counts": {"x": "y"}}, "'counts.x' must be a whole number, not 'y'"),
        ({"flag": 1}, "'flag' must be true or false, not 1"),
        ({"name": "\ud800"}, "'name' must be text, not '\\ud800'"),
        ({"extra": 1}, "'extra' is unknown"),
        ({"inner": {"extra": 1}}, "'inner.extra' is unknown"),
        ({"inner": 5}, "'inner' must be a table of values, not 5"),
    ],
)
def test_what_does_not_fit_is_named(change, line):
    with pytest.raises(WrongValue) as caught:
        load_dataclass(Outer, {**PLAIN, **change})
    assert str(caught.value) == line


def test_a_missing_entry_and_the_name_of_the_whole():
    with pytest.raises(WrongValue, match=r"'file\.name' is missing"):
        load_dataclass(Outer, {key: PLAIN[key] for key in ("inner", "many")}, "file")
    assert load_dataclass(Inner, {"rate": 1, "new": 2}, ignore_extra=True) == Inner(1)


JUNK = st.none() | st.integers() | st.text() | st.lists(st.floats())


@given(st.sampled_from(sorted(PLAIN)), JUNK)
def test_any_value_in_any_place_fits_or_is_refused(name, junk):
    try:
        load_dataclass(Outer, {**PLAIN, name: junk})
    except WrongValue as error:
        assert name in str(error)  # noqa: PT017 - anything else is a crash


def test_an_empty_text_is_said_in_words():
    assert one_of("", "s", "ms").expected == "one of s, ms, or '' to leave it open"
