"""Records as JSON values: parsed records equal the dumped records, and no type is converted."""

import json
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.config.json_records import Codec
from fieldkit.config.schema import Field


class Colour(StrEnum):
    RED = "red"
    BLUE = "blue"


@dataclass(frozen=True)
class Part:
    at_m: tuple[float, float]
    names: tuple[str, ...] = ()


@dataclass(frozen=True)
class Record:
    number: int
    colour: Annotated[Colour, Field(alias="paint")]
    parts: tuple[Part, ...] = ()
    by_name: dict[str, Part] | None = None
    excused: bool = False


CODEC = Codec(Record)
COMPLETE = {"number": 1, "paint": "red"}

finite_floats = st.floats(allow_nan=False, allow_infinity=False)
parts = st.builds(Part, st.tuples(finite_floats, finite_floats), st.lists(st.text(), max_size=3).map(tuple))
records = st.builds(
    Record,
    st.integers(),
    st.sampled_from(Colour),
    st.lists(parts, max_size=3).map(tuple),
    st.none() | st.dictionaries(st.text(), parts, max_size=3),
    st.booleans(),
)


@given(records)
def test_dumped_records_parse_to_equal_records(record: Record) -> None:
    assert CODEC.parse(json.loads(json.dumps(CODEC.dump(record)))) == record


def test_fields_are_dumped_with_their_alias() -> None:
    assert CODEC.dump(Record(1, Colour.RED)) == {**COMPLETE, "parts": [], "by_name": None, "excused": False}


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({}, "number: Field required"),
        (COMPLETE | {"number": "1"}, "number: Input should be a valid integer"),
        (COMPLETE | {"number": 1.5}, "number: Input should be a valid integer"),
        (COMPLETE | {"excused": 1}, "excused: Input should be a valid boolean"),
        (COMPLETE | {"paint": "green"}, "paint: Input should be 'red' or 'blue'"),
        (COMPLETE | {"parts": [{"at_m": [0, 1, 2]}]}, "parts.0.at_m: Tuple should have at most 2 items"),
        ([], "Input should be an object"),
        (None, "Input should be an object"),
    ],
)
def test_invalid_record_is_rejected_with_the_field_path(data: object, message: str) -> None:
    with pytest.raises(ValueError, match=message) as error_info:
        CODEC.parse(data)
    assert type(error_info.value) is ValueError
