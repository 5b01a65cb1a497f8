from dataclasses import asdict, replace

import numpy as np
import pytest

from fieldkit import columns
from fieldkit.analysis.statistics import bootstrap, wilson
from fieldkit.analysis.summary import summarize
from fieldkit.columns import CellRow, RepeatRow
from fieldkit.model import Protocol, Scenario, Status

UDP = RepeatRow(
    scenario="los",
    topology="master",
    backend="emulated",
    distance="30ft",
    distance_m=9.144,
    protocol="udp",
    status="valid",
    ip_packets_sent=216,
    ip_packets_received=206,
    ip_loss=10 / 216,
    datagrams_sent=36,
    datagrams_received=30,
    datagram_loss=6 / 36,
    byte_loss=0.05,
    file_loss=0.2,
    paper_packets=36,
    paper_received=35,
    paper_loss=1 / 36,
    rtt_sent=20,
    rtt_received=20,
    rtt_loss=0.0,
    rtt_median_s=0.010,
    transfer_s=1.0,
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


def test_counts_are_pooled_and_the_spread_is_over_repeats() -> None:
    (cell,) = summarize([UDP, WORSE], seed=1)
    pooled = wilson(40, 432)
    assert (cell.ip_loss, cell.ip_loss_low, cell.ip_loss_high) == (pooled.value, pooled.low, pooled.high)
    assert (cell.ip_loss_min, cell.ip_loss_max) == (10 / 216, 30 / 216)
    assert cell.datagram_loss == 22 / 72
    assert (cell.rtt_loss, cell.rtt_loss_low, cell.rtt_loss_high) == (0, 0, wilson(0, 40).high)


def test_shares_of_bytes_and_times_vary_by_the_repeat() -> None:
    rows = [replace(UDP, byte_loss=0.01 * n, transfer_s=1.0 + n) for n in range(9)]
    (cell,) = summarize(rows, seed=1)
    wide = bootstrap([0.01 * n for n in range(9)], "mean", np.random.default_rng(0))
    assert cell.byte_loss == pytest.approx(0.04)
    assert cell.byte_loss_low == pytest.approx(wide.low, abs=0.002)
    assert cell.byte_loss_high == pytest.approx(wide.high, abs=0.002)
    assert (cell.byte_loss_min, cell.byte_loss_max) == (0.0, 0.08)
    assert cell.transfer_s == 5.0
    assert cell.transfer_s_low is not None
    assert cell.transfer_s_high is not None
    assert 1.0 <= cell.transfer_s_low < 5.0 < cell.transfer_s_high <= 9.0


def test_only_valid_rows_are_measured_and_all_are_counted() -> None:
    void, failed = replace(WORSE, status=Status.VOID), replace(WORSE, status="failed")
    (cell,) = summarize([UDP, void, void, failed], seed=1)
    assert (cell.n_valid, cell.n_void, cell.n_failed) == (1, 2, 1)
    assert cell.ip_loss == 10 / 216


def test_a_cell_without_a_valid_row_is_empty_but_there() -> None:
    (cell,) = summarize([replace(UDP, status="failed")], seed=1)
    measured = {name: value for name, value in asdict(cell).items() if value is not None}
    assert measured == {
        "scenario": "los",
        "topology": "master",
        "backend": "emulated",
        "distance": "30ft",
        "distance_m": 9.144,
        "protocol": "udp",
        "n_valid": 0,
        "n_void": 0,
        "n_failed": 1,
    }


def test_a_single_repeat_has_no_bootstrap_interval() -> None:
    (cell,) = summarize([UDP], seed=1)
    assert (cell.transfer_s, cell.transfer_s_low, cell.transfer_s_high) == (1.0, None, None)
    assert (cell.byte_loss, cell.byte_loss_low, cell.byte_loss_min) == (0.05, None, 0.05)
    assert cell.ip_loss_low is not None


def test_a_filter_that_offload_deceives_gives_no_interval() -> None:
    (cell,) = summarize([replace(UDP, paper_packets=22, paper_received=209, paper_loss=1 - 209 / 22)], seed=1)
    assert (cell.paper_loss, cell.paper_loss_low, cell.paper_loss_high) == (1 - 209 / 22, None, None)


def test_missing_measures_are_left_out_of_the_pool() -> None:
    blind = replace(WORSE, ip_packets_received=None, ip_loss=None, transfer_s=None)
    (cell,) = summarize([UDP, blind], seed=1)
    assert (cell.ip_loss, cell.transfer_s) == (10 / 216, 1.0)


def test_conditions_are_kept_apart_in_the_order_of_the_rows() -> None:
    far, tcp, wall = (
        replace(UDP, distance="55ft", distance_m=16.764),
        replace(UDP, protocol="tcp"),
        replace(UDP, scenario="nlos"),
    )
    cells = summarize([far, UDP, tcp, wall, UDP], seed=1)
    assert [(cell.distance, cell.protocol, cell.scenario, cell.n_valid) for cell in cells] == [
        ("55ft", "udp", "los", 1),
        ("30ft", "udp", "los", 2),
        ("30ft", "tcp", "los", 1),
        ("30ft", "udp", "nlos", 1),
    ]


def test_intervals_depend_on_the_seed_and_the_cells_own_rows_alone() -> None:
    rows = [replace(UDP, transfer_s=float(n) ** 1.5, byte_loss=n / 97) for n in range(12)]
    (alone,) = summarize(rows, seed=1)
    among = summarize([replace(UDP, distance="1m"), *rows], seed=1)[1]
    assert among == alone
    assert summarize(rows, seed=2)[0].byte_loss_low != alone.byte_loss_low


def test_rows_read_from_a_table_give_what_rows_in_memory_give() -> None:
    rows = [replace(UDP, byte_loss=n / 97) for n in range(12)]
    typed = [replace(row, scenario=Scenario.LOS, protocol=Protocol.UDP, status=Status.VALID) for row in rows]
    written = [columns.to_csv(CellRow, summarize(these, seed=1)) for these in (rows, typed)]
    assert written[0] == written[1]


def test_no_rows_give_no_cells() -> None:
    assert summarize([], seed=1) == ()


def test_columns_of_a_cell_are_declared_in_families() -> None:
    names = [column.name for column in columns.declared(CellRow)]
    at = names.index("ip_loss")
    assert names[at : at + 5] == ["ip_loss", "ip_loss_low", "ip_loss_high", "ip_loss_min", "ip_loss_max"]
    assert names[:2] == ["procedure", "scenario"]
