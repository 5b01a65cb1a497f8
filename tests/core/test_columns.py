"""Columns and what is measured of them: one value for each, or a reason why there is none."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.columns import Column, Measured, cell, columns

DECLARED = columns(10, ("a", "count", "x"), ("b", "s", "x"), ("c", "text", "x"))
NAMES = ("a", "b", "c", "d")

measured = st.builds(
    Measured, values=st.dictionaries(st.sampled_from(NAMES), st.integers()), missing=st.just({})
) | st.builds(Measured, missing=st.dictionaries(st.sampled_from(NAMES), st.text(min_size=1)))


def test_two_values_for_one_column_are_refused_even_if_they_are_equal() -> None:
    one = Measured({"a": 1, "b": 2.0, "c": "x"})
    with pytest.raises(ValueError, match=r"^measured twice: a, c$"):
        one | Measured({"c": "x", "a": 1})


def test_a_value_overrides_that_it_is_missing_on_either_side() -> None:
    value, missing = Measured({"a": 0}), Measured(missing={"a": "not captured", "b": "no ping"})
    for both in (value | missing, missing | value):
        assert both == Measured({"a": 0}, {"b": "no ping"})


def test_the_first_reason_for_which_a_column_is_missing_stands() -> None:
    assert (Measured(missing={"a": "first"}) | Measured(missing={"a": "second"})).missing == {"a": "first"}


@given(measured, measured)
def test_nothing_is_lost_and_nothing_is_both(one: Measured, other: Measured) -> None:
    if one.values.keys() & other.values.keys():
        with pytest.raises(ValueError, match="measured twice"):
            one | other
        return
    both = one | other
    assert both.values == {**one.values, **other.values}
    assert both.values.keys() | both.missing.keys() == {*one.values, *one.missing, *other.values, *other.missing}
    assert not both.values.keys() & both.missing.keys()
    assert one | Measured() == one == Measured() | one


def test_none_is_missing_and_zero_and_false_are_values() -> None:
    found = Measured.of({"a": 0, "b": None, "c": False, "d": ""}, "not at hand")
    assert found == Measured({"a": 0, "c": False, "d": ""}, {"b": "not at hand"})


def test_all_declared_columns_can_be_missing_for_one_reason() -> None:
    assert Measured.nothing(DECLARED, "no capture") == Measured(missing=dict.fromkeys("abc", "no capture"))


def test_the_unit_tells_the_type_of_values() -> None:
    assert [column.type for column in DECLARED] == [int, float, str]
    assert {column.rank for column in DECLARED} == {10}


def test_a_value_at_a_bound_of_more_digits_than_a_cell_has_is_read_again() -> None:
    ends = 1.0000000004, 2.0000000006
    column = Column("level", "dBm", "x", bounds=ends)
    assert [cell(end) for end in ends] == ["1", "2"]
    assert [column.problem(cell(end)) for end in ends] == [None, None]
    assert column.problem("0.999999999") == "not from 1 to 2"
    assert column.problem("2.00000001") is not None
