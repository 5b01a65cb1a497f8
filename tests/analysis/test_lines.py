"""Lines of tables: lines for an operator, payload sizes of round-trip times, and numbers of repeats."""

from collections.abc import Sequence
from pathlib import Path

import pytest

from fieldkit.analysis import paper_tables, repeats, table_lines
from fieldkit.analysis.cells import Cell, aggregate
from fieldkit.analysis.quantities import DEFAULT_BY, quantities
from fieldkit.cli import main
from fieldkit.core.columns import Column, Figure, Kind
from fieldkit.trial import rows
from fieldkit.trial.columns import trial_columns
from tests.helpers.tables import ROW, RepeatRow, replace, write

PINGED = replace(ROW, rtt_sent=10, rtt_received=9, rtt_loss=0.1, rtt_payload_bytes=8192, jitter_s=0.001)
TCP = replace(
    PINGED,
    protocol="tcp",
    rtt_payload_bytes=502,
    ip_loss=None,
    ip_packets_sent=None,
    ip_packets_received=None,
    tcp_byte_loss=0.01,
    paper_packets=40,
    paper_received=40,
    paper_loss=0.0,
)


def cells_of(table: Sequence[RepeatRow]) -> tuple[Cell, ...]:
    return aggregate(repeats.parse(rows.to_csv(table, trial_columns()).encode(), trial_columns()))


def texts_by_label(cells: Sequence[Cell], lines: Sequence[table_lines.TableLine]) -> dict[str, list[str]]:
    return {line.label: [line.amount(cell, line.scale(cells)) for cell in cells] for line in lines}


def test_the_label_of_a_round_trip_time_has_the_payload_size() -> None:
    figures = texts_by_label(cells := cells_of([TCP, PINGED]), table_lines.lines(cells))
    assert figures["RTT, 502-byte ping, median"] == ["10.00 ms", ""]
    assert figures["RTT, 8192-byte ping, median"] == ["", "10.00 ms"]


def test_the_label_has_the_range_of_payload_sizes() -> None:
    figures = texts_by_label(
        cells := cells_of([PINGED, replace(PINGED, repeat=2, rtt_payload_bytes=56)]), table_lines.lines(cells)
    )
    assert [label for label in figures if "RTT" in label] == ["RTT, 56- to 8192-byte ping, median"]


@pytest.mark.parametrize("form", ["markdown", "latex"])
def test_tables_for_papers_have_payload_size_and_number_of_repeats(form: str) -> None:
    to_text = {"markdown": paper_tables.to_markdown, "latex": paper_tables.to_latex}[form]
    table = [
        PINGED,
        *(replace(PINGED, repeat=2 + n, rtt_loss=1.0, rtt_received=0, rtt_median_s=None) for n in (0, 1)),
    ]
    text = to_text(DEFAULT_BY, cells_of(table), quantities(trial_columns()))
    assert "RTT, 8192-byte ping, median (ms)" in text
    assert "10.00 (1 of 3)" in text
    text = to_text(DEFAULT_BY, cells_of(table[1:]), quantities(trial_columns()))
    assert "none, 0 of 2" in text


def test_a_condition_without_any_reply_is_shown(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    without_reply = replace(
        PINGED, trial="far", distance="60ft", distance_m=18.288, rtt_loss=1.0, rtt_received=0, rtt_median_s=None
    )
    assert main(["aggregate", str(write(tmp_path, [PINGED, without_reply])), "--quantity", "rtt_median_s"]) == 0
    figures = capsys.readouterr().out
    assert "RTT, 8192-byte ping (ms)" in figures
    assert [line.split() for line in figures.splitlines() if line.startswith(" 60ft")][-1] == ["60ft", "0", "of", "1"]


def test_radio_losses_of_tcp_and_udp_are_one_line_unless_a_condition_has_both() -> None:
    cells = cells_of([TCP, PINGED])
    figures = texts_by_label(cells, table_lines.with_radio_loss(table_lines.operator_lines(cells), cells))
    assert figures["radio loss"] == ["1.00 %", "4.63 %"]
    cells_with_both = cells_of([replace(PINGED, tcp_byte_loss=0.01)])
    labels = texts_by_label(
        cells_with_both, table_lines.with_radio_loss(table_lines.operator_lines(cells_with_both), cells_with_both)
    )
    assert {"IP packet loss", "TCP byte loss before retransmission"} <= labels.keys()
    assert "radio loss" not in labels


def test_lines_for_an_operator_include_expected_and_additional_quantities() -> None:
    additional = Column("probe.level", "dBm", "Level.", figure=Figure("probe: level", Kind.MEDIAN))
    columns = (*trial_columns(), additional)
    row = replace(PINGED, transfer_stall_s=0.4, transfer_stalls=1)
    row["probe.level"] = -60.0
    content = rows.to_csv([row], columns).encode()
    cells = aggregate(repeats.parse(content, columns))
    labels = [line.label for line in table_lines.operator_lines(cells)]
    assert "probe: level, median" in labels
    hidden_labels = {
        "jitter_s": "last jitter value (RFC 3550), median",
        "transfer_stall_s": "longest stall of the transfer, median",
        "transfer_stalls": "stalls of the transfer",
    }
    for name, label in hidden_labels.items():
        assert label not in labels
        assert label in [line.label for line in table_lines.operator_lines(cells, {name})]
    assert labels.index("file loss") < labels.index("ping loss") < labels.index("RTT, 8192-byte ping, median")


def test_figures_of_equal_rank_are_in_the_order_of_columns() -> None:
    additional = [Column(f"m{n}", "V", "Voltage.", figure=Figure(f"m{n}", Kind.MEDIAN)) for n in range(12)]
    columns = (*trial_columns(), *additional)
    row = replace(PINGED) | {column.name: 7.4 for column in additional}
    cells = aggregate(repeats.parse(rows.to_csv([row], columns).encode(), columns))
    labels = [line.label for line in table_lines.operator_lines(cells)]
    assert [label for label in labels if label.startswith("m")] == [f"m{n}, median" for n in range(12)]


def test_all_lines_are_shown_if_there_are_no_lines_for_an_operator() -> None:
    without_metrics = replace(ROW, file_loss=None, ip_loss=None, rtt_median_s=None, ip_packets_sent=None)
    assert [line.label for line in table_lines.operator_lines(cells_of([without_metrics]))] == [
        "transfer time, median"
    ]


def test_sent_packets_are_summed_over_all_valid_repeats() -> None:
    cells = cells_of([TCP, PINGED, replace(PINGED, repeat=2), replace(PINGED, repeat=3, status="void")])
    assert table_lines.sent_counts(cells) == {"packets sent": ["40", "432"]}
