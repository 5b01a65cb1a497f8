from collections.abc import Sequence

import pytest

from fieldkit.analysis import result_tables
from fieldkit.analysis.cells import Cell, aggregate
from fieldkit.analysis.quantities import DEFAULT_BY
from fieldkit.analysis.repeats import parse
from fieldkit.core.model import Status
from fieldkit.trial.columns import trial_columns
from tests.helpers.single import mean_share, share, wilson
from tests.helpers.tables import ROW, RepeatRow, parsed, replace

UDP = replace(
    ROW,
    datagrams_sent=36,
    datagrams_received=30,
    datagram_loss=6 / 36,
    byte_loss=0.05,
    paper_packets=36,
    paper_received=35,
    paper_loss=1 / 36,
    rtt_sent=20,
    rtt_received=20,
    rtt_loss=0.0,
)
WORSE = replace(
    UDP,
    ip_packets_received=186,
    ip_loss=30 / 216,
    byte_loss=0.15,
    rtt_median_s=0.012,
    transfer_s=3.0,
    datagrams_received=20,
)


def summarize(rows: Sequence[RepeatRow]) -> tuple[Cell, ...]:
    return aggregate(parsed(rows))


def test_counts_are_summed_and_intervals_are_over_repeats() -> None:
    (cell,) = summarize([UDP, WORSE])
    loss = cell.estimates["ip_loss"]
    pooled = wilson(40, 432)
    assert (loss.value, loss.wilson_low, loss.wilson_high) == (pooled.value, pooled.low, pooled.high)
    over_repeats = share([10, 30], [216, 216])
    assert over_repeats is not None
    assert (loss.low, loss.high) == (over_repeats.low, over_repeats.high)
    assert over_repeats.low < pooled.low < pooled.high < over_repeats.high
    assert (loss.events, loss.trials, loss.n) == (40, 432, 2)
    assert (loss.minimum, loss.maximum) == pytest.approx((10 / 216, 30 / 216))
    assert cell.estimates["datagram_loss"].value == 22 / 72
    assert cell.estimates["rtt_loss"].value == 0


def test_intervals_of_byte_shares_and_times_are_over_repeats() -> None:
    rows = [replace(UDP, byte_loss=0.01 * n, transfer_s=1.0 + n) for n in range(9)]
    (cell,) = summarize(rows)
    loss, time = cell.estimates["byte_loss"], cell.estimates["transfer_s"]
    over_repeats = mean_share([0.01 * n for n in range(9)])
    assert over_repeats is not None
    assert loss.value == pytest.approx(0.04)
    assert (loss.low, loss.high) == pytest.approx((over_repeats.low, over_repeats.high))
    assert (loss.minimum, loss.maximum, loss.wilson_low) == (0.0, 0.08, None)
    assert time.low is not None
    assert time.high is not None
    assert 1.0 <= time.low < time.value == 5.0 < time.high <= 9.0


def test_estimates_use_valid_rows_and_all_rows_are_counted() -> None:
    void, failed = replace(WORSE, status=Status.VOID), replace(WORSE, status="failed")
    (cell,) = summarize([UDP, void, void, failed])
    assert (cell.n_valid, cell.n_void, cell.n_failed) == (1, 2, 1)
    assert cell.estimates["ip_loss"].value == 10 / 216


def test_a_cell_without_a_valid_row_is_kept_without_estimates() -> None:
    cells = summarize([replace(UDP, status="failed")])
    assert cells[0].estimates == {}
    header, line = result_tables.to_csv(DEFAULT_BY, cells).splitlines()
    values = dict(zip(header.split(","), line.split(","), strict=True))
    assert {name: value for name, value in values.items() if value} == {
        "procedure": "los",
        "scenario": "los",
        "topology": "master",
        "backend": "field",
        "distance": "30ft",
        "distance_m": "9.144",
        "protocol": "udp",
        "n_valid": "0",
        "n_void": "0",
        "n_failed": "1",
    }


def test_a_single_repeat_has_no_interval_over_repeats() -> None:
    (cell,) = summarize([UDP])
    assert (cell.estimates["transfer_s"].value, cell.estimates["transfer_s"].low) == (1.0, None)
    assert (cell.estimates["byte_loss"].value, cell.estimates["byte_loss"].low) == (0.05, None)
    assert (cell.estimates["ip_loss"].value, cell.estimates["ip_loss"].low) == (10 / 216, None)
    assert cell.estimates["ip_loss"].wilson_low is not None


def test_more_received_than_sent_packets_because_of_offload_give_no_interval() -> None:
    (cell,) = summarize([replace(UDP, paper_packets=22, paper_received=209, paper_loss=1 - 209 / 22)])
    loss = cell.estimates["paper_loss"]
    assert (loss.value, loss.low, loss.wilson_low, loss.wilson_high) == (1 - 209 / 22, None, None, None)


def test_missing_values_are_omitted_from_sums() -> None:
    without_capture = replace(WORSE, ip_packets_received=None, ip_loss=None, transfer_s=None)
    (cell,) = summarize([UDP, without_capture])
    assert (cell.estimates["ip_loss"].value, cell.estimates["ip_loss"].n) == (10 / 216, 1)
    assert cell.estimates["transfer_s"].value == 1.0


def test_conditions_are_separate_and_sorted() -> None:
    rows = [
        replace(UDP, distance=label, distance_m=metres, protocol=protocol, scenario=scenario)
        for label, metres in (("100ft", 30.48), ("9.1m", 9.1), ("30ft", 9.144))
        for protocol in ("udp", "tcp")
        for scenario in ("nlos", "los")
    ]
    cells = summarize([*rows, UDP])
    conditions = [
        (*(cell.key[name] for name in ("scenario", "distance", "protocol")), cell.n_valid) for cell in cells
    ]
    assert conditions == [
        (scenario, distance, protocol, 1 + ((scenario, distance, protocol) == ("los", "30ft", "udp")))
        for scenario in ("los", "nlos")
        for distance in ("9.1m", "30ft", "100ft")
        for protocol in ("tcp", "udp")
    ]


def test_any_column_can_identify_conditions_and_missing_values_come_first() -> None:
    rows = [
        replace(UDP, repeat=2),
        replace(UDP, repeat=None),
        replace(UDP, repeat=10),
        replace(UDP, repeat=None, distance="near"),
    ]
    assert [cell.key for cell in aggregate(parsed(rows), ["repeat", "distance"])] == [
        {"repeat": None, "distance": "near"},
        {"repeat": None, "distance": "30ft"},
        {"repeat": 2.0, "distance": "30ft"},
        {"repeat": 10.0, "distance": "30ft"},
    ]
    assert [cell.n_valid for cell in aggregate(parsed(rows), [])] == [4]


def test_intervals_depend_only_on_the_rows_of_their_cell() -> None:
    rows = [replace(UDP, transfer_s=float(n) ** 1.5, byte_loss=n / 97) for n in range(12)]
    (cell,) = summarize(rows)
    same_cell = summarize([replace(UDP, distance="1m"), *rows])[1]
    assert same_cell == cell


def test_no_rows_give_no_cells() -> None:
    assert summarize([]) == ()


def test_columns_that_an_older_table_lacks_have_no_values() -> None:
    older_table = parse(b"protocol,status,transfer_s,hash_match\nudp,valid,1.5,true\nudp,void,,\n", trial_columns())
    assert older_table.column("transfer_s") == [1.5, None]
    assert older_table.column("hash_match") == [1.0, None]
    assert older_table.column("ip_loss") == [None, None]
    assert older_table.column("scenario") == ["", ""]
