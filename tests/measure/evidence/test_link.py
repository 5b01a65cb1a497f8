"""Columns of a link: closed forms of a few samples."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.columns import cell
from fieldkit.core.model import LinkSample, Role, StationSample
from fieldkit.measure.evidence import link

S = 10**9
ONE = StationSample("aa", -50.0, 65e6, 58.5e6, 10, 100, 1, 0, 0)


def samples(*stations: StationSample, cell: str | None = None) -> list[LinkSample]:
    return [
        LinkSample(at * S, (station,), cell, -95.0 + at, 1000 * at, 250 * at) for at, station in enumerate(stations)
    ]


def measured(found: list[LinkSample]) -> dict[str, object]:
    return {name.removeprefix("sender_"): value for name, value in link.measure(Role.SENDER, found).values.items()}


def test_each_column_is_what_it_says() -> None:
    found = samples(
        ONE,
        replace(ONE, signal_dbm=-70.0, tx_rate_bit_s=6.5e6, tx_packets=15, tx_retries=4),
        replace(ONE, signal_dbm=-55.0, tx_packets=30, rx_packets=130, tx_retries=9, tx_failures=2, beacon_losses=1),
    )
    assert measured(found) == {
        "signal_median_dbm": -55.0,
        "signal_min_dbm": -70.0,
        "signal_last_dbm": -55.0,
        "noise_dbm": -94.0,
        "busy_share": 0.25,
        "tx_rate_bit_s": 65e6,
        "rx_rate_bit_s": 58.5e6,
        "radio_tx_packets": 20,
        "radio_rx_packets": 30,
        "tx_retries": 8,
        "tx_failures": 2,
        "beacon_losses": 1,
        "link_samples": 3,
    }


def test_nothing_is_missing_without_a_reason() -> None:
    names = {column.name for column in link.COLUMNS}
    for found in ([], samples(ONE), [LinkSample(0)]):
        told = [link.measure(role, found) for role in link.ROLES]
        assert names == {name for one in told for name in (*one.values, *one.missing)}
    assert "no Wi-Fi, or no iw" in link.measure(Role.SENDER, []).missing["sender_signal_min_dbm"]
    assert "tx_retries" not in measured(samples(ONE)), "one sample of a counter says nothing of the repeat"


COUNTS = st.none() | st.integers(0, 10**18)
POWERS = st.none() | st.floats(-1e6, 1e6)


@given(
    st.lists(
        st.builds(
            LinkSample,
            st.integers(0, 10**9),
            st.builds(StationSample, st.sampled_from("ab"), POWERS, POWERS, POWERS, COUNTS, COUNTS).map(
                lambda one: (one,)
            ),
            st.none() | st.sampled_from("ab"),
            POWERS,
            COUNTS,
            COUNTS,
        ),
        max_size=5,
    )
)
def test_whatever_a_driver_tells_the_table_can_be_read_again(found: list[LinkSample]) -> None:
    told = link.measure(Role.SENDER, found)
    for column in link.COLUMNS[: len(link.COLUMNS) // 2]:
        assert (column.name in told.values) is not (column.name in told.missing)
        assert not column.problem(cell(told.values.get(column.name)))


def test_an_access_points_link_is_that_with_the_most_packets() -> None:
    other = replace(ONE, station="bb", signal_dbm=-80.0, tx_packets=0, rx_packets=10**6)
    found = [
        LinkSample(0, (other, ONE)),
        LinkSample(S, (other, replace(ONE, tx_packets=60, signal_dbm=-52.0))),
        LinkSample(2 * S, (replace(other, tx_packets=40), StationSample("", -51.0))),
    ]
    assert measured(found)["radio_tx_packets"] == 50
    assert measured(found)["signal_min_dbm"] == -52.0
    assert measured(found)["signal_last_dbm"] == -51.0, "the kernel's own line, where iw was not called"
    assert "roams" not in measured(found)


def test_a_station_that_roams_goes_on_counting() -> None:
    far = replace(ONE, station="bb", tx_packets=4, tx_retries=0)
    found = [
        *samples(ONE, replace(ONE, tx_packets=15), cell="aa"),
        LinkSample(2 * S, (far,), "bb"),
        LinkSample(3 * S, (replace(far, tx_packets=9),)),
        LinkSample(4 * S, (), "aa"),
    ]
    assert measured(found)["roams"] == 2
    assert measured(found)["radio_tx_packets"] == 5 + 4 + 5


@pytest.mark.parametrize("busy", [[0, 500, 100], [900, 1400, 1500]])
def test_a_channels_counters_may_begin_anew(busy: list[int]) -> None:
    active = [1000, 2000, 200] if busy[-1] < busy[1] else [1000, 2000, 2200]
    found = [LinkSample(at, active_ns=a, busy_ns=b) for at, (a, b) in enumerate(zip(active, busy, strict=True))]
    assert link.busy_share(found) == pytest.approx(600 / 1200)
