"""Tables of the paper in all formats."""

import csv
import io
import json
import math

import pytest

from sim_backends.cosim.commands import table
from sim_backends.cosim.studies.intervals import IntervalEstimate
from sim_backends.cosim.studies.paper_claims import Claim
from sim_backends.cosim.studies.paper_tables import PaperCell, PaperRow, Printed

NAN = math.nan
LOSS_CELL = PaperCell(Printed("10", 100, "10"), IntervalEstimate(0.07, 0.065, 0.075), 3)
EMPTY_CELL = PaperCell(Printed("0.01"), IntervalEstimate(NAN, NAN, NAN), 0)
WIDE_CELL = PaperCell(Printed("54.309"), IntervalEstimate(30.0, 0.0, 60.0), 3)
ROWS = [
    PaperRow({"line": "los", "distance_m": 20, "protocol": "topic"}, EMPTY_CELL, LOSS_CELL, "out of range"),
    PaperRow({"line": "nlos", "distance_m": 20, "protocol": "topic"}, WIDE_CELL, LOSS_CELL, ""),
]
CLAIMS = [
    Claim("fixed window", "all", "delay", Printed("-12", 100), NAN, IntervalEstimate(-0.01, -0.02, 0.01), 5),
    Claim("master-based", "nlos", "loss", None, -0.14, IntervalEstimate(0.5, 0.4, 0.6), 5),
]


def test_csv_has_si_units_and_every_column(capsys: pytest.CaptureFixture[str]) -> None:
    table.paper_sheet("title", ROWS, is_ping=False).show("csv")
    first, second = csv.DictReader(io.StringIO(capsys.readouterr().out))
    assert (first["protocol"], first["delay_s"], first["delay_agreement"]) == ("topic", "", "no value")
    assert (float(first["loss_paper"]), float(first["loss"]), first["loss_agreement"]) == (0.1, 0.07, "agrees")
    assert float(second["delay_off_s"]) == pytest.approx(30.0 - 54.309)


def test_tables_show_only_labels_that_differ_between_rows_and_the_printed_digits(
    capsys: pytest.CaptureFixture[str],
) -> None:
    table.paper_sheet("title", ROWS, is_ping=False).show("table")
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["nlos", "54.309", "30", "0", "60", "3", "agrees", "-24.3"] in lines, (
        "all rows have the same distance and protocol"
    )
    assert ["los", "10", "7", "6.5", "7.5", "agrees", "-3", "out", "of", "range"] in lines


def test_cells_that_agree_only_by_a_wide_interval_are_counted_separately() -> None:
    text = table.summary(ROWS)
    assert "3 of 4 cells agree: 2 by the simulated mean, 1 only because the simulated interval is wide" in text


def test_a_table_shows_claims_beside_the_statements_and_tables_of_the_paper(
    capsys: pytest.CaptureFixture[str],
) -> None:
    sheet = table.claim_sheet("title", CLAIMS)
    sheet.show("table")
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["fixed", "window", "all", "delay", "-12", "-", "-1", "-2", "1", "5", "above"] in lines
    assert ["master-based", "nlos", "loss", "-", "-14", "50", "40", "60", "5", "-"] in lines
    sheet.show("json")
    first, second = json.loads(capsys.readouterr().out)
    assert (first["paper"], first["tables"], first["ours"]) == (-0.12, None, -0.01)
    assert (second["paper"], second["tables"], second["agreement"]) == (None, -0.14, "")
