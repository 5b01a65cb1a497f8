"""Columns of a link, computed by hand from a few samples."""

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.columns import cell_text
from fieldkit.core.model import LinkSample, Role, StationSample
from fieldkit.measure.evidence import link

S = 10**9
SAMPLE = StationSample("aa", -50.0, 65e6, 58.5e6, 10, 100, 1, 0, 0)


def samples(*stations: StationSample, cell: str | None = None) -> list[LinkSample]:
    return [
        LinkSample(second * S, (station,), cell, -95.0 + second, 1000 * second, 250 * second)
        for second, station in enumerate(stations)
    ]


def measure_values(link_samples: list[LinkSample]) -> dict[str, object]:
    return {
        name.removeprefix("sender_"): value for name, value in link.measure(Role.SENDER, link_samples).values.items()
    }


def test_each_column_has_the_expected_value() -> None:
    link_samples = samples(
        SAMPLE,
        replace(SAMPLE, signal_dbm=-70.0, tx_rate_bit_s=6.5e6, tx_packets=15, tx_retries=4),
        replace(
            SAMPLE, signal_dbm=-55.0, tx_packets=30, rx_packets=130, tx_retries=9, tx_failures=2, beacon_losses=1
        ),
    )
    assert measure_values(link_samples) == {
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


def test_each_column_has_a_value_or_a_reason() -> None:
    names = {column.name for column in link.COLUMNS}
    for link_samples in ([], samples(SAMPLE), [LinkSample(0)]):
        measured_link = [link.measure(role, link_samples) for role in link.ROLES]
        assert names == {name for item in measured_link for name in (*item.values, *item.missing)}
    assert "no Wi-Fi or no iw" in link.measure(Role.SENDER, []).missing["sender_signal_min_dbm"]
    assert "tx_retries" not in measure_values(samples(SAMPLE)), "an increment needs two samples"


COUNTS = st.none() | st.integers(0, 10**18)
POWERS = st.none() | st.floats(-1e6, 1e6)


@given(
    st.lists(
        st.builds(
            LinkSample,
            st.integers(0, 10**9),
            st.builds(StationSample, st.sampled_from("ab"), POWERS, POWERS, POWERS, COUNTS, COUNTS).map(
                lambda item: (item,)
            ),
            st.none() | st.sampled_from("ab"),
            POWERS,
            COUNTS,
            COUNTS,
        ),
        max_size=5,
    )
)
def test_any_values_of_a_driver_give_valid_cells_or_are_missing(link_samples: list[LinkSample]) -> None:
    measured_link = link.measure(Role.SENDER, link_samples)
    for column in link.COLUMNS[: len(link.COLUMNS) // 2]:
        assert (column.name in measured_link.values) is not (column.name in measured_link.missing)
        assert not column.invalid_value_reason(cell_text(measured_link.values.get(column.name)))


def test_the_link_of_an_access_point_is_that_of_the_station_with_the_most_packets() -> None:
    other_station = replace(SAMPLE, station="bb", signal_dbm=-80.0, tx_packets=0, rx_packets=10**6)
    link_samples = [
        LinkSample(0, (other_station, SAMPLE)),
        LinkSample(S, (other_station, replace(SAMPLE, tx_packets=60, signal_dbm=-52.0))),
        LinkSample(2 * S, (replace(other_station, tx_packets=40), StationSample("", -51.0))),
    ]
    assert measure_values(link_samples)["radio_tx_packets"] == 50
    assert measure_values(link_samples)["signal_min_dbm"] == -52.0
    assert measure_values(link_samples)["signal_last_dbm"] == -51.0, (
        "the sample of /proc/net/wireless, because iw was not called"
    )
    assert "roams" not in measure_values(link_samples)


def test_counters_continue_when_a_station_roams() -> None:
    second_cell = replace(SAMPLE, station="bb", tx_packets=4, tx_retries=0)
    link_samples = [
        *samples(SAMPLE, replace(SAMPLE, tx_packets=15), cell="aa"),
        LinkSample(2 * S, (second_cell,), "bb"),
        LinkSample(3 * S, (replace(second_cell, tx_packets=9),)),
        LinkSample(4 * S, (), "aa"),
    ]
    assert measure_values(link_samples)["roams"] == 2
    assert measure_values(link_samples)["radio_tx_packets"] == 5 + 4 + 5


def test_counters_of_a_new_link_start_from_zero() -> None:
    # From mac80211 of a robot that roamed: the counter of the next access point is above that of the previous one.
    first_cell = StationSample("02:00:00:00:00:00", -30.0, 1e6, 1e6, 11, 1522, 0, 0, 1)
    second_cell = StationSample("02:00:00:00:03:00", -30.0, 1e6, 1e6, 139, 1775, 0, 0, 0)
    link_samples = [
        LinkSample(0, (first_cell,)),
        LinkSample(S, (replace(first_cell, tx_packets=21, rx_packets=1530),), first_cell.station),
        LinkSample(2 * S, (second_cell,)),
    ]
    assert measure_values(link_samples)["roams"] == 1, "only the station dump shows the new access point"
    assert measure_values(link_samples)["radio_tx_packets"] == 10 + 139
    assert measure_values(link_samples)["radio_rx_packets"] == 8 + 1775
    assert measure_values(link_samples)["beacon_losses"] == 0


def test_counts_after_the_last_sample_of_a_replaced_link_are_unknown() -> None:
    # From mac80211 of a robot that was deauthenticated 50 s after the last sample.
    before = StationSample("02:00:00:00:00:00", -30.0, 1e6, 1e6, 33, 10211, 0, 0, 1)
    after = replace(before, tx_packets=158, rx_packets=781, beacon_losses=0)
    link_samples = [LinkSample(0, (before,), before.station), LinkSample(50 * S, (after,))]
    measured_link = link.measure(Role.SENDER, link_samples)
    assert measured_link.values["sender_roams"] == 0
    for name in ("radio_tx_packets", "radio_rx_packets", "tx_retries", "tx_failures", "beacon_losses"):
        assert "established again" in measured_link.missing[f"sender_{name}"]


def test_the_link_of_a_station_with_several_peers_is_that_of_its_access_point() -> None:
    peer = replace(SAMPLE, station="peer", tx_packets=5000)
    link_samples = [
        LinkSample(0, (SAMPLE, peer)),
        LinkSample(S, (replace(SAMPLE, tx_packets=12),), "aa"),
        LinkSample(2 * S, (replace(SAMPLE, tx_packets=17), peer)),
    ]
    assert measure_values(link_samples)["radio_tx_packets"] == 7
    assert measure_values(link_samples)["roams"] == 0


@pytest.mark.parametrize("busy", [[0, 500, 100], [900, 1400, 1500]])
def test_counters_of_a_channel_may_restart(busy: list[int]) -> None:
    active = [1000, 2000, 200] if busy[-1] < busy[1] else [1000, 2000, 2200]
    link_samples = [
        LinkSample(at_ns, active_ns=active_ns, busy_ns=busy_ns)
        for at_ns, (active_ns, busy_ns) in enumerate(zip(active, busy, strict=True))
    ]
    assert link.busy_share(link_samples) == pytest.approx(600 / 1200)
