"""Tables with missing and impossible values: errors name file, line and column; no output has nan or inf."""

import csv
import io
import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fieldkit.analysis.table_files import read
from fieldkit.cli import main
from fieldkit.core.columns import SCHEMA_VERSION, Column
from fieldkit.core.errors import ConfigurationError, EvidenceError
from fieldkit.trial.columns import trial_columns
from fieldkit.trial.rows import to_csv
from tests.helpers.nightly import examples
from tests.helpers.tables import COMPARABLE, ROW, RepeatRow, repeats, replace, write


def as_csv(rows: Sequence[RepeatRow]) -> str:
    return to_csv(rows, trial_columns())


COLUMNS = {column.name: column for column in trial_columns()}


@pytest.mark.parametrize(
    ("name", "text", "reason"),
    [
        ("ip_loss", "-38460", "not from 0 to 1"),
        ("file_loss", "5", "not from -1000 to 1"),
        ("paper_loss", "-38460", "not from -1000 to 1"),
        ("sent_bytes", "-1", "not from 0 to 9.00719925e+15"),
        ("rtt_sent", "2.5", "not a whole number, which the unit count requires"),
        ("rtt_median_s", "-0.001", "not from 0 to 1e+10"),
        ("transfer_s", "1e308", "not from 0 to 1e+10"),
        ("transfer_s", "1e400", "not from 0 to 1e+10"),
        ("seed", "9007199254740994", "not from 0 to 9.00719925e+15"),
        ("started_utc_ns", "9223372036854775808", "not from 0 to 9.22337204e+18"),
        ("started_utc_ns", "-5", "not from 0 to 9.22337204e+18"),
        ("started_utc_ns", "1e18", "not a whole number, which the unit ns requires"),
        ("started_utc_ns", "9" * 5000, "not from 0 to 9.22337204e+18"),
        ("hash_match", "yes", "not true or false"),
        ("jitter_s", "1_000", "not a number"),
        ("jitter_s", "0,5", "not a number"),
        ("jitter_s", "-inf", "not a number"),
        ("goodput_bit_s", "-1", "not from 0 to 1e+15"),
    ],
)
def test_the_error_of_an_impossible_value_names_its_place(tmp_path: Path, name: str, text: str, reason: str) -> None:
    path = write(tmp_path, repeats(ROW, 4))
    with path.open(encoding="utf-8", newline="") as file:
        lines = list(csv.DictReader(file))
    lines[2][name] = text
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, lines[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)
    with pytest.raises(EvidenceError) as error_info:
        read([path], trial_columns())
    assert error_info.value.where == f"{path}:4"
    assert error_info.value.what.startswith(f"{name} is '{text[:40]}")
    assert error_info.value.what.endswith(f", {reason}")
    assert "fieldkit rebuild TRIAL" in error_info.value.remedy


def test_a_share_that_its_counts_contradict_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path, [*repeats(ROW, 2), replace(ROW, repeat=3, ip_loss=0.5)])
    with pytest.raises(EvidenceError, match=r"ip_loss is 0\.5, but ip_packets_received is 206 of 216") as error_info:
        read([path], trial_columns())
    assert error_info.value.where == f"{path}:4"


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda text: text.replace(",", ";").encode(), "its cells are separated by semicolons"),
        (lambda text: in_quotes(text, ";").encode(), "its cells are separated by semicolons"),
        (lambda text: text.replace(",", "\t").encode(), "its cells are separated by tabs"),
        (lambda text: text.encode("utf-16"), "its encoding is UTF-16"),
        (lambda text: b'"' + b"x" * 200_000 + text.encode(), "it lacks schema_version"),
    ],
    ids=["semicolons", "semicolons, quoted", "tabs", "UTF-16", "no table"],
)
def test_a_table_that_a_spreadsheet_changed_is_an_error(
    tmp_path: Path, damage: Callable[[str], bytes], message: str
) -> None:
    path = tmp_path / "saved.csv"
    path.write_bytes(damage(as_csv(repeats(ROW, 2))))
    with pytest.raises(ConfigurationError, match=message):
        read([path], trial_columns())


def in_quotes(text: str, delimiter: str) -> str:
    """Return a table in which every cell is in quotes, as some spreadsheets save it."""
    out = io.StringIO()
    csv.writer(out, delimiter=delimiter, quoting=csv.QUOTE_ALL).writerows(csv.reader(io.StringIO(text)))
    return out.getvalue()


def test_columns_without_a_name_are_omitted(tmp_path: Path) -> None:
    path = tmp_path / "saved.csv"
    path.write_text("".join(f"{line},,\n" for line in as_csv(repeats(ROW, 2)).splitlines()), encoding="utf-8")
    assert len(read([path], trial_columns())) == 2


def test_the_error_of_a_shortened_time_has_a_remedy(tmp_path: Path) -> None:
    path = tmp_path / "saved.csv"
    table = as_csv([replace(ROW, started_utc_ns=1_795_309_790_492_337_123)])
    path.write_text(table.replace("1795309790492337123", "1.79531E+18"), encoding="utf-8")
    with pytest.raises(EvidenceError, match="not a whole number") as error_info:
        read([path], trial_columns())
    assert "a spreadsheet has removed digits" in error_info.value.remedy


def test_a_time_keeps_its_nanoseconds_next_to_a_missing_value(tmp_path: Path) -> None:
    at_ns = 1_795_309_790_492_337_123
    path = write(tmp_path, [replace(ROW, started_utc_ns=at_ns), replace(ROW, repeat=2)])
    assert read([path], trial_columns()).column("started_utc_ns") == [at_ns, None]
    for kind in ("csv", "parquet"):
        assert main(["export", str(path), "--format", kind, "-o", str(tmp_path / f"out.{kind}")]) == 0
    assert pa.parquet.read_table(tmp_path / "out.parquet")["started_utc_ns"].to_pylist() == [at_ns, None]
    assert str(at_ns) in (tmp_path / "out.csv").read_text(encoding="utf-8")


def test_a_share_without_its_counts_is_missing(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rows = repeats(ROW, 4)
    path = write(tmp_path, [*rows[:3], replace(rows[3], ip_packets_sent=None)])
    assert main(["aggregate", str(path), "--quantity", "ip_loss", "--format", "json"]) == 0
    (cell,) = json.loads(capsys.readouterr().out)["cells"]
    assert (cell["n_valid"], cell["estimates"]["ip_loss"]["n"], cell["estimates"]["ip_loss"]["trials"]) == (4, 3, 648)


def cells_of(column: Column) -> st.SearchStrategy[str]:
    """Return a strategy for cells of a column: empty, possible values, bounds, and errors of programs and people."""
    low, high = column.possible_range
    hostile = st.sampled_from(
        ["nan", "NaN", "inf", "-1", "2.5", "1e308", "-38460", "true", "TRUE", "NA", "9" * 400, "\x1b[31m<b>|&%", "0"]
    )
    if column.type is str:
        return st.sampled_from(["", "a", "b", "nan", "=1+1", "<script>", "a|b\\", "\u202e", "30ft", "9" * 400 + "ft"])
    if column.type is bool:
        return st.sampled_from(["", "true", "false", "TRUE", "0", "1"]) | hostile
    if column.type is int:
        return st.sampled_from(["", "0", "1", "36", f"{int(high)}"]) | st.integers(0, 300).map(str) | hostile
    return st.sampled_from(["", f"{low:.9g}", f"{high:.9g}", "0.1", "1e-300"]) | st.floats(0, 1).map(repr) | hostile


def valid_cells_of(column: Column) -> st.SearchStrategy[str]:
    """Return a strategy for possible or empty cells of a column."""
    return cells_of(column).filter(lambda text: column.invalid_value_reason(text) is None)


HOSTILE_COLUMNS = (
    "trial", "procedure", "scenario", "topology", "backend", "distance", "distance_m", "protocol", "repeat",
    "attempt", "started_utc_ns", "seed", "reason", "sender", "sent_bytes", "file_loss", "hash_match", "bag_messages",
    "tcp_byte_loss", "datagrams_sent", "tcp_superframes", "rtt_median_s", "transfer_s", "goodput_bit_s",
    "one_way_withheld", "rtt_sent", "rtt_received", "rtt_loss", "paper_loss", "paper_packets", "paper_received",
    "reboot_recovered", "reboot_recovery_s", "ip_packets_sent",
)  # fmt: skip
"""Columns that are used in tables."""


@st.composite
def hostile_tables(draw: st.DrawFn) -> str:
    """Return a table of repeats in which some cells are empty, and a few are impossible."""
    lines = [
        dict(csv_row) for csv_row in csv.DictReader(io.StringIO(as_csv(repeats(COMPARABLE, draw(st.integers(1, 8))))))
    ]
    cells = valid_cells_of if draw(st.booleans()) else cells_of
    for line in lines:
        for name in draw(st.lists(st.sampled_from(HOSTILE_COLUMNS), max_size=6)):
            line[name] = draw(cells(COLUMNS[name]))
        line["status"] = draw(st.sampled_from(["valid", "valid", "valid", "void", "failed"]))
    return _text(lines)


def _text(lines: list[dict[str, str]]) -> str:
    out = io.StringIO()
    writer = csv.DictWriter(out, lines[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(lines)
    return out.getvalue()


NOT_A_NUMBER = re.compile(r"(?<![\w<])(nan|-?inf|NaN|Infinity|-9223372036854775808)(?![\w>])")


def _parse_strict_json(text: str) -> Any:  # noqa: ANN401 (any JSON)
    def refuse(word: str) -> float:
        raise AssertionError(word)

    return json.loads(text, parse_constant=refuse)


def _check_numbers_are_finite(text: str) -> None:
    """Check that no number column of a CSV contains nan or inf."""
    for line in csv.DictReader(io.StringIO(text)):
        for name, cell in line.items():
            if cell and (name not in COLUMNS or COLUMNS[name].type is not str) and name not in TEXT_COLUMNS:
                assert cell in {"true", "false"} or math.isfinite(float(cell)), (name, cell)


TEXT_COLUMNS = frozenset(("quantity", "unit", "estimate", "missing_in", "verdict"))


@given(hostile_tables(), hostile_tables())
@settings(max_examples=8, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_commands_only_exit_with_documented_codes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], first: str, second: str
) -> None:
    a, b = tmp_path / "a.csv", tmp_path / "b.csv"
    a.write_text(first, encoding="utf-8")
    b.write_text(second, encoding="utf-8")

    def run(*argv: str) -> str:
        code = main(list(argv))
        out = capsys.readouterr().out
        assert code in {0, 1, 2, 4}, (argv, code)
        return out if code in {0, 1} else ""

    for form in ("json", "csv", "table", "markdown", "latex"):
        aggregated = run("aggregate", str(a), "--format", form)
        compared = run("compare", str(a), str(b), "--force", "--format", form) if form != "latex" else ""
        for text in filter(None, (aggregated, compared)):
            if form == "json":
                _parse_strict_json(text)
            elif form == "csv":
                _check_numbers_are_finite(text)
    (tmp_path / "out.csv").unlink(missing_ok=True)
    if run("export", str(a), "--format", "csv", "-o", str(tmp_path / "out.csv")):
        _check_numbers_are_finite((tmp_path / "out.csv").read_text(encoding="utf-8"))
    (tmp_path / "out.parquet").unlink(missing_ok=True)
    if run("export", str(a), "--format", "parquet", "-o", str(tmp_path / "out.parquet")):
        for name, column in zip(*_columns(tmp_path / "out.parquet"), strict=True):
            assert COLUMNS[name].type is str or all(value is None or math.isfinite(value) for value in column), name


def _columns(path: Path) -> tuple[list[str], list[list[Any]]]:
    table_read = pa.parquet.read_table(path)
    return table_read.column_names, [column.to_pylist() for column in table_read.columns]


@given(hostile_tables())
@settings(max_examples=3, suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)
def test_a_report_of_any_table_is_written_or_refused(tmp_path: Path, first: str) -> None:
    table, page = tmp_path / "a.csv", tmp_path / "report.html"
    table.write_text(first.replace("nan", ""), encoding="utf-8")
    page.unlink(missing_ok=True)
    code = main(["report", str(table), "-o", str(page)])
    assert code in {0, 2, 4}
    if code == 0:
        assert not NOT_A_NUMBER.search(
            re.sub(r"<(style|script)>.*?</\1>", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
        )


NUMBERS = [column for column in trial_columns() if column.type is not str]


@given(st.sampled_from(NUMBERS).flatmap(lambda column: st.tuples(st.just(column), cells_of(column))))
@settings(max_examples=examples(60))
def test_every_column_accepts_exactly_its_possible_values(column_and_cell: tuple[Column, str]) -> None:
    column, text = column_and_cell
    line = dict.fromkeys(COLUMNS, "") | {"status": "valid", column.name: text}
    content = _text([line]).encode()
    invalid_reason = column.invalid_value_reason(text)
    if column.name == "schema_version" and not invalid_reason and float(text or "nan") > SCHEMA_VERSION:
        invalid_reason = "its schema version is"
    if invalid_reason is None:
        table_read = read([Path("a.csv")], trial_columns(), content=lambda _: content)
        assert not np.isinf(table_read.numbers[column.name]).any()
    else:
        with pytest.raises((EvidenceError, ConfigurationError), match=re.escape(invalid_reason)):
            read([Path("a.csv")], trial_columns(), content=lambda _: content)
