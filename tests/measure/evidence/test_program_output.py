"""Values in the output of programs."""

import json
import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.columns import Column
from fieldkit.core.errors import EvidenceError
from fieldkit.measure.evidence import program_output

STATUS = '{"battery": {"cells": [{"mV": 3712}, {"mV": 3698}]}, "ok": true, "mode": "auto"}'


def column(unit: str) -> Column:
    return Column("x", unit, "X.")


@pytest.fixture
def output(tmp_path: Path) -> Path:
    path = tmp_path / "run.txt"
    path.write_text(STATUS, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("path", "unit", "value"),
    [
        ("battery.cells[0].mV", "mV", 3712.0),
        ("battery.cells[-1].mV", "count", 3698),
        ("sum(battery.cells[].mV)", "mV", 7410.0),
        ("ok", "bool", True),
        ("mode", "text", "auto"),
    ],
)
def test_a_path_extracts_a_value_of_its_column(output: Path, path: str, unit: str, value: object) -> None:
    extracted = program_output.to_column_value(column(unit), program_output.at_path(output, path))
    assert (extracted, type(extracted)) == (value, type(value))


@pytest.mark.parametrize(
    ("extracted", "unit", "reason"),
    [
        (None, "V", "the value is missing"),
        ("", "text", "the value is missing"),
        ({"a": 1}, "text", "instead of a single value"),
        ([], "V", "instead of a single value"),
        (True, "V", "another type"),
        (1, "bool", "another type"),
        ("12.3 V", "V", "'12.3 V', not a number"),
        (12.5, "count", "not a whole number"),
        (math.inf, "V", "not a number"),
        (-1, "B", "not from 0"),
        (2, "share", "not from 0 to 1"),
        (10**400, "count", "not from"),
    ],
)
def test_an_invalid_value_is_an_error(extracted: object, unit: str, reason: str) -> None:
    with pytest.raises(EvidenceError, match=reason):
        program_output.to_column_value(column(unit), extracted)


def test_a_number_as_text_is_accepted_and_texts_are_sanitized() -> None:
    assert program_output.to_column_value(column("V"), " 12.5\n") == 12.5
    assert program_output.to_column_value(column("count"), "1e3") == 1000
    sanitized = str(program_output.to_column_value(column("text"), "a\x1b[31m\u202eb\r\nc" + 500 * "d"))
    assert sanitized.startswith("a?[31m?b c")
    assert len(str(program_output.to_column_value(column("text"), 500 * "d"))) == 200


def test_an_expression_extracts_the_first_match_of_its_group(output: Path) -> None:
    output.write_text("signal: -61 dBm\nnoise: -95 dBm\nsignal: -70 dBm\n", encoding="utf-8")
    assert program_output.by_expression(output, r"^signal: (-?[0-9]+)") == "-61"
    assert program_output.by_expression(output, r"(?s).*signal: (-?[0-9]+)") == "-70"
    assert program_output.by_expression(output, r"^rate: ([0-9]+)") is None


def test_an_expression_with_catastrophic_backtracking_is_fast(output: Path) -> None:
    """The module `re` of Python would need 2^100000 steps for this expression."""
    output.write_text(100_000 * "a" + "b", encoding="utf-8")
    assert program_output.by_expression(output, r"^(a+)+$") is None


@pytest.mark.parametrize("text", ["(", "a", "(a)(b)", r"(a)\1", "(?=a)(b)"])
def test_an_expression_without_exactly_one_group_is_refused(text: str) -> None:
    assert program_output.expression_error(text)


@pytest.mark.parametrize("text", ["", "a[", "a b", "f("])
def test_an_invalid_path_is_refused(text: str) -> None:
    assert program_output.path_error(text)


def test_valid_paths_and_expressions_are_accepted() -> None:
    assert program_output.path_error("a.b[0].c") is None
    assert program_output.expression_error("(?:a|b)([0-9.]+)") is None


@pytest.mark.parametrize("text", ["", "{", "{'a': 1}", 100_000 * "[", STATUS[:-9], "NaN x", "9" * 5000])
def test_invalid_json_is_an_error(output: Path, text: str) -> None:
    output.write_text(text, encoding="utf-8")
    with pytest.raises(EvidenceError, match="is not JSON"):
        program_output.at_path(output, "a")


def test_a_byte_order_mark_is_ignored_and_the_last_of_duplicate_keys_is_used(output: Path) -> None:
    output.write_text('\ufeff{"a": 3, "a": 4}', encoding="utf-8")
    assert program_output.at_path(output, "a") == 4


def test_a_path_that_does_not_match_the_data_is_an_error(output: Path) -> None:
    with pytest.raises(EvidenceError, match="sum"):
        program_output.at_path(output, "sum(mode)")


def test_truncated_output_is_an_error(output: Path) -> None:
    output.write_bytes(b" " * (program_output.MAX_OUTPUT_BYTES - 1))
    assert len(program_output.text(output)) == program_output.MAX_OUTPUT_BYTES - 1
    output.write_bytes(b" " * program_output.MAX_OUTPUT_BYTES)
    with pytest.raises(EvidenceError, match="more than 1 MiB"):
        program_output.text(output)


@given(
    st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
        lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    ),
    st.sampled_from(["V", "count", "B", "ns", "s", "share", "bool", "text"]),
)
def test_any_extracted_value_is_a_valid_cell_or_an_error(extracted: object, unit: str) -> None:
    extracted = json.loads(json.dumps(extracted))
    try:
        value = program_output.to_column_value(column(unit), extracted)
    except EvidenceError:
        return
    assert isinstance(value, column(unit).type)
    if not isinstance(value, str):
        assert column(unit).invalid_value_reason(json.dumps(value)) is None
    else:
        assert value.isprintable()


@pytest.mark.parametrize("path", ["(" * 5000 + "a" + ")" * 5000, "a" + "|a" * 5000])
def test_a_path_that_is_nested_too_deeply_is_an_error(output: Path, path: str) -> None:
    if reason := program_output.path_error(path):
        assert reason == "it is nested too deeply"
        return
    with pytest.raises(EvidenceError, match="nested too deeply"):
        program_output.at_path(output, path)
