"""Records from JSON: what was written is read, an absent field is its default, and every mistake is named."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, field, fields, replace
from typing import Any, Literal

import pytest
from hypothesis import given
from hypothesis import strategies as st

from dual_system.models.config_json import deviations, from_json


@dataclass(frozen=True, kw_only=True)
class Inner:
    width: int
    rate: float = 0.5
    name: Literal["full", "isolated"] = "full"


@dataclass(frozen=True, kw_only=True)
class Outer:
    """Every kind of field that a record may have."""

    depth: int
    inner: Inner
    others: tuple[Inner, ...] = ()
    box: tuple[float, ...] = (0.0, 1.0)
    limit: float | None = None
    part: Inner | None = None
    speaks: bool = True
    text: str = ""
    made: Inner = field(default_factory=lambda: Inner(width=1))


finite = st.floats(-1e6, 1e6)
inners = st.builds(Inner, width=st.integers(), rate=finite, name=st.sampled_from(["full", "isolated"]))
outers = st.builds(
    Outer,
    depth=st.integers(),
    inner=inners,
    others=st.lists(inners, max_size=2).map(tuple),
    box=st.lists(finite, max_size=3).map(tuple),
    limit=st.none() | finite,
    part=st.none() | inners,
    speaks=st.booleans(),
    text=st.text(max_size=4),
    made=st.just(Inner(width=1)) | inners,
)
OPTIONAL = [each.name for each in fields(Outer)][2:]


def as_json(record: Any) -> Any:
    return json.loads(json.dumps(asdict(record)))


def default(record: Outer, name: str) -> Any:
    return getattr(Outer(depth=record.depth, inner=record.inner), name)


@given(outers)
def test_what_was_written_is_read(record: Outer) -> None:
    assert from_json(Outer, as_json(record), "here") == record


@given(outers, st.sets(st.sampled_from(OPTIONAL)))
def test_an_absent_field_is_its_default(record: Outer, absent: set[str]) -> None:
    values = {name: value for name, value in as_json(record).items() if name not in absent}
    expected = replace(record, **{name: default(record, name) for name in absent})
    assert from_json(Outer, values, "here") == expected


@given(outers)
def test_deviations_are_what_a_file_must_say(record: Outer) -> None:
    """They are enough to read the record back, and name no field that is at its default."""
    said = deviations(record)
    changed = {name for name in OPTIONAL if getattr(record, name) != default(record, name)}
    assert set(said) == {"depth", "inner"} | changed
    plain = json.loads(json.dumps(said, default=asdict))
    assert from_json(Outer, plain, "here") == record


@given(outers, outers)
def test_equal_deviations_are_equal_records(one: Outer, other: Outer) -> None:
    assert (deviations(one) == deviations(other)) == (one == other)


def test_a_number_may_be_written_as_an_integer() -> None:
    assert from_json(Inner, {"width": 1, "rate": 1}, "here") == Inner(width=1, rate=1.0)


GOOD = as_json(Outer(depth=1, inner=Inner(width=2)))


@pytest.mark.parametrize("needed", ["depth", "inner"])
def test_a_missing_field_without_a_default_is_named(needed: str) -> None:
    values = {name: value for name, value in GOOD.items() if name != needed}
    with pytest.raises(ValueError, match=rf"here: missing \['{needed}'\], unknown \[\]"):
        from_json(Outer, values, "here")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"colour": 1}, r"^here: missing \[\], unknown \['colour'\]"),
        ({"inner": {"width": 1, "colour": 1}}, r"^here\.inner: missing \[\], unknown \['colour'\]"),
        ({"others": [{"width": 1}, {}]}, r"^here\.others\[1\]: missing \['width'\], unknown \[\]"),
        ({"part": {}}, r"^here\.part: missing \['width'\]"),
        ({"depth": "1"}, r"^here\.depth: expected int, came '1'"),
        ({"depth": 1.5}, r"^here\.depth: expected int, came 1\.5"),
        ({"depth": True}, r"^here\.depth: expected int, came True"),
        ({"depth": None}, r"^here\.depth: expected int, came None"),
        ({"inner": {"width": 1, "name": "half"}}, r"^here\.inner\.name: expected 'full' or 'isolated', came 'half'"),
        ({"inner": [1]}, r"^here\.inner: expected an object, came \[1\]"),
        ({"box": [0, "1"]}, r"^here\.box\[1\]: expected float, came '1'"),
        ({"box": 1}, r"^here\.box: expected .*, came 1"),
        ({"limit": []}, r"^here\.limit: expected .*, came \[\]"),
        ({"limit": float("nan")}, r"^here\.limit: expected a finite number, came nan"),
        ({"box": [0, float("-inf")]}, r"^here\.box\[1\]: expected a finite number, came -inf"),
        (
            {"others": [{"width": 1, "rate": 10**400}]},
            r"^here\.others\[0\]\.rate: expected a finite number, came 100",
        ),
        ({"speaks": 1}, r"^here\.speaks: expected bool, came 1"),
        ({"text": 1}, r"^here\.text: expected str, came 1"),
    ],
)
def test_a_value_that_does_not_fit_is_named(change: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        from_json(Outer, GOOD | change, "here")


@pytest.mark.parametrize("values", [None, [1, 2], "text", 1])
def test_what_is_no_object_is_refused(values: object) -> None:
    with pytest.raises(ValueError, match="here: expected an object, came"):
        from_json(Outer, values, "here")


def test_only_records_are_read() -> None:
    with pytest.raises(TypeError, match="is no dataclass"):
        from_json(int, {}, "here")
