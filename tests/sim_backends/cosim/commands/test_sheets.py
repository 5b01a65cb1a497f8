"""Tables in four formats: missing values are not replaced, and CSV and JSON have SI units."""

import csv
import io
import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.cosim.commands.sheets import FORMS, Sheet, SheetColumn, SheetPart, number_text

SHEET = Sheet(
    (
        SheetColumn("policy", "policy", ""),
        SheetColumn("delay_s", "delay (ms)", "mean delay", 1e3),
        SheetColumn("packets", "packets", "number of packets"),
    ),
    [("a | b", 0.0015, 12345), ("c", math.nan, None)],
    [SheetPart("all", ("policy", "delay_s", "packets")), SheetPart("some", ("policy", "delay_s"))],
)


def test_csv_and_json_have_si_units_and_leave_missing_values_empty(capsys: pytest.CaptureFixture[str]) -> None:
    SHEET.show("csv")
    rows = list(csv.DictReader(io.StringIO(capsys.readouterr().out)))
    assert [row["delay_s"] for row in rows] == ["0.0015", ""]
    SHEET.show("json")
    assert json.loads(capsys.readouterr().out) == [
        {"policy": "a | b", "delay_s": 0.0015, "packets": 12345},
        {"policy": "c", "delay_s": None, "packets": None},
    ]


def test_a_table_shows_each_part_and_explains_each_column_once(capsys: pytest.CaptureFixture[str]) -> None:
    SHEET.show("table")
    out = capsys.readouterr().out
    assert out.count("delay: mean delay") == 1
    assert [line.split() for line in out.splitlines() if line.startswith(" c ")] == [["c", "-", "-"], ["c", "-"]]
    assert "12,345" in out
    SHEET.show("markdown")
    assert "| a &#124; b | 1.5 | 12,345 |" in capsys.readouterr().out


def test_a_table_without_rows_is_not_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    for form in FORMS:
        Sheet(SHEET.columns, [], SHEET.parts).show(form)
    assert "policy,delay_s,packets" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (0.012345, "0.0123"),
        (12.345, "12.3"),
        (999.6, "1,000"),
        (12345.6, "12,346"),
        (1.234e8, "1.23e+08"),
    ],
)
def test_a_number_has_an_exponent_only_if_it_is_very_small_or_large(value: float, text: str) -> None:
    assert number_text(value) == text


@given(st.floats(allow_nan=False, allow_infinity=False, width=32))
def test_a_number_is_rounded_to_three_digits(value: float) -> None:
    assert float(number_text(value).replace(",", "")) == pytest.approx(value, rel=0.005)
