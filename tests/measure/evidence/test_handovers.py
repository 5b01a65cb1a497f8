"""Handovers from sequences of access points, and gaps of handovers from pings with a given gap."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.columns import Measured
from fieldkit.core.model import LinkSample
from fieldkit.measure.evidence import handovers, ping, robot_link_samples
from fieldkit.measure.evidence.handovers import Handover

START_NS = 1_700_000_000 * 10**9
RTT_NS = 3_000_000


def output(count: int, interval_ns: int, unanswered: set[int]) -> ping.Ping:
    """Return parsed output of `ping -D`. Request n was sent at START_NS + n intervals."""
    lines = ["PING 10.0.0.1 (10.0.0.1) 56(84) bytes of data."]
    for number in range(count):
        if number not in unanswered:
            seconds, rest_ns = divmod(START_NS + number * interval_ns + RTT_NS, 10**9)
            lines.append(
                f"[{seconds}.{rest_ns // 1000:06}] 64 bytes from 10.0.0.1: icmp_seq={number + 1} ttl=64 time=3.00 ms"
            )
    lines += ["", "--- 10.0.0.1 ping statistics ---"]
    lines.append(f"{count} packets transmitted, {count - len(unanswered)} received, 9% packet loss, time 9ms")
    return ping.parse("\n".join(lines) + "\n")


def samples(cells: list[str | None], period_ns: int) -> list[LinkSample]:
    return [LinkSample(START_NS + number * period_ns, cell=cell) for number, cell in enumerate(cells)]


def measure_handovers(recorded: list[LinkSample], result: ping.Ping, interval_ns: int) -> Measured:
    return handovers.measure(recorded, result, interval_ns / 1e9, ping_pong_s=10.0)


@given(
    interval_ms=st.integers(5, 500),
    outage_start_ms=st.integers(2000, 6000),
    outage_ms=st.integers(1, 3000),
    sample_ms=st.integers(50, 1000),
)
def test_gap_and_loss_of_an_outage_equal_the_closed_form(
    interval_ms: int, outage_start_ms: int, outage_ms: int, sample_ms: int
) -> None:
    """In an outage [a, b), n = ceil(b / i) - ceil(a / i) requests are lost; the gap is (n + 1) i."""
    interval_ns = interval_ms * 1_000_000
    first_lost = -(-outage_start_ms // interval_ms)
    lost_end = -(-(outage_start_ms + outage_ms) // interval_ms)
    count = max(lost_end, 9000 // interval_ms) + 20
    outage_end_ms = outage_start_ms + outage_ms
    cells = [
        "a" if at_ms < outage_start_ms else None if at_ms < outage_end_ms else "b"
        for at_ms in range(0, count * interval_ms, sample_ms)
    ]
    result = measure_handovers(
        samples([*cells], sample_ms * 1_000_000),
        output(count, interval_ns, {*range(first_lost, lost_end)}),
        interval_ns,
    )
    n_lost = lost_end - first_lost
    assert result.values["roam_gap_s"] == pytest.approx((n_lost + 1) * interval_ms / 1e3, abs=2e-6)
    assert result.values["roam_lost"] == n_lost
    assert (result.values["roam_ap_before"], result.values["roam_ap_after"]) == ("a", "b")
    assert (result.values["roam_handovers"], result.values["roam_ping_pongs"]) == (1, 0)


def test_losses_away_from_the_handover_do_not_count() -> None:
    cells = ["a"] * 20 + ["b"] * 20
    result = measure_handovers(
        samples([*cells], 200_000_000), output(80, 100_000_000, {5, 6, 7, 40, 60, 61}), 100_000_000
    )
    assert result.values["roam_lost"] == 1
    assert result.values["roam_gap_s"] == pytest.approx(0.2)


def test_requests_in_a_gap_of_two_handovers_count_once() -> None:
    cells = ["a"] * 10 + ["b", "c"] + ["c"] * 10
    result = measure_handovers(samples([*cells], 200_000_000), output(40, 100_000_000, {*range(18, 24)}), 100_000_000)
    assert (result.values["roam_handovers"], result.values["roam_lost"]) == (2, 6)


def test_a_gap_that_is_open_at_the_end_of_the_ping_is_a_lower_bound() -> None:
    cells = ["a"] * 10 + ["b"] * 10
    result = measure_handovers(samples([*cells], 200_000_000), output(40, 100_000_000, {*range(19, 40)}), 100_000_000)
    assert "roam_gap_s" in result.missing
    assert result.values["roam_gap_at_least_s"] == pytest.approx(2.1)
    assert result.values["roam_lost"] == 21


def test_samples_after_the_ping_do_not_count() -> None:
    cells = ["a"] * 10 + ["b"] * 20 + ["a"] * 20
    result = measure_handovers(samples([*cells], 200_000_000), output(40, 100_000_000, set()), 100_000_000)
    assert (result.values["roam_ap_after"], result.values["roam_handovers"]) == ("b", 1)


def test_a_return_to_the_previous_access_point_within_the_limit_is_a_ping_pong() -> None:
    handover_list = [
        Handover(*pair, second * 10**9, second * 10**9)
        for pair, second in ((("a", "b"), 0), (("b", "a"), 10), (("a", "b"), 21))
    ]
    assert handovers.count_ping_pongs(handover_list, 10.0) == 1
    assert handovers.count_ping_pongs(handover_list, 11.0) == 2
    assert handovers.count_ping_pongs([Handover("a", "b", 0, 0), Handover("b", "c", 1, 1)], 10.0) == 0


def test_a_new_association_with_the_same_access_point_is_not_a_handover() -> None:
    assert handovers.find_handovers(samples(["a", None, "a"], 10**9)) == []
    (handover,) = handovers.find_handovers(samples(["a", None, None, "b"], 10**9))
    assert handover.joined_ns - handover.left_ns == 3 * 10**9


def test_each_column_has_a_value_or_a_reason() -> None:
    names = {column.name for column in handovers.COLUMNS}
    pings = [output(40, 100_000_000, set()), output(40, 100_000_000, {*range(40)}), None]
    for cells in (["a"] * 9, ["a"] * 9 + ["b"] * 9, [None] * 9):
        for ping_result in pings:
            result = handovers.measure(samples([*cells], 200_000_000), ping_result, 0.1, ping_pong_s=10.0)
            assert names == {*result.values, *result.missing}
    result = measure_handovers(samples([None] * 9, 200_000_000), output(40, 100_000_000, set()), 100_000_000)
    assert "no access point" in result.missing["roam_ap_before"]


def test_a_station_dump_narrows_the_time_of_a_handover() -> None:
    """On a robot `iw link` is called every 5 s, and again when `iw station get` of the access point fails."""
    old, new = "04:f0:21:00:00:01", "04:f0:21:00:00:02"
    link_text = "Connected to {} (on wlan0)\n\tSSID: lab\n\tsignal: -61 dBm\n"
    station_text = "Station {} (on wlan0)\n\tsignal:  \t-61 dBm\n"
    text = f"==> 100.00 link <==\n{link_text.format(old)}"
    text += "".join(
        f"==> 10{tenths // 10}.{tenths % 10}0 station <==\n{station_text.format(old)}" for tenths in (2, 12, 24)
    )
    text += f"==> 102.60 station <==\n==> 102.80 link <==\n{link_text.format(new)}"
    (handover,) = handovers.find_handovers(robot_link_samples.parse(text))
    assert (handover.old, handover.new) == (old, new)
    assert (handover.left_ns, handover.joined_ns) == (102_400_000_000, 102_800_000_000)
