"""Columns and measured values: each column has one value, or a reason why it is missing."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.columns import Column, Measured, cell_text, columns

DECLARED = columns(10, ("a", "count", "x"), ("b", "s", "x"), ("c", "text", "x"))
NAMES = ("a", "b", "c", "d")

measured = st.builds(
    Measured, values=st.dictionaries(st.sampled_from(NAMES), st.integers()), missing=st.just({})
) | st.builds(Measured, missing=st.dictionaries(st.sampled_from(NAMES), st.text(min_size=1)))


def test_two_values_for_one_column_are_refused_even_if_they_are_equal() -> None:
    first = Measured({"a": 1, "b": 2.0, "c": "x"})
    with pytest.raises(ValueError, match=r"^measured twice: a, c$"):
        first | Measured({"c": "x", "a": 1})


def test_a_value_replaces_a_missing_reason_on_either_side() -> None:
    value, missing = Measured({"a": 0}), Measured(missing={"a": "not captured", "b": "no ping"})
    for combined in (value | missing, missing | value):
        assert combined == Measured({"a": 0}, {"b": "no ping"})


def test_the_first_missing_reason_is_kept() -> None:
    assert (Measured(missing={"a": "first"}) | Measured(missing={"a": "second"})).missing == {"a": "first"}


@given(measured, measured)
def test_a_union_keeps_all_columns_as_either_measured_or_missing(first: Measured, second: Measured) -> None:
    if first.values.keys() & second.values.keys():
        with pytest.raises(ValueError, match="measured twice"):
            first | second
        return
    combined = first | second
    assert combined.values == {**first.values, **second.values}
    assert combined.values.keys() | combined.missing.keys() == {
        *first.values,
        *first.missing,
        *second.values,
        *second.missing,
    }
    assert not combined.values.keys() & combined.missing.keys()
    assert first | Measured() == first == Measured() | first


def test_none_means_missing_but_zero_and_false_are_values() -> None:
    measured = Measured.from_optional({"a": 0, "b": None, "c": False, "d": ""}, "not available")
    assert measured == Measured({"a": 0, "c": False, "d": ""}, {"b": "not available"})


def test_all_declared_columns_can_be_missing_for_one_reason() -> None:
    assert Measured.all_missing(DECLARED, "no capture") == Measured(missing=dict.fromkeys("abc", "no capture"))


def test_the_unit_determines_the_type_of_values() -> None:
    assert [column.type for column in DECLARED] == [int, float, str]
    assert {column.rank for column in DECLARED} == {10}


def test_a_rounded_value_at_a_bound_is_still_possible() -> None:
    bounds = 1.0000000004, 2.0000000006
    column = Column("level", "dBm", "x", bounds=bounds)
    assert [cell_text(bound) for bound in bounds] == ["1", "2"]
    assert [column.invalid_value_reason(cell_text(bound)) for bound in bounds] == [None, None]
    assert column.invalid_value_reason("0.999999999") == "not from 1 to 2"
    assert column.invalid_value_reason("2.00000001") is not None


def test_columns_without_a_rank_are_refused_because_the_first_column_would_be_lost() -> None:
    with pytest.raises(TypeError, match="the first argument of columns is the rank"):
        columns(("hops", "count", "Hops."))  # type: ignore[arg-type]
