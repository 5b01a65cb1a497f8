"""UDP over links with closed-form results: loss of fragments, delay, queues, and range."""

import pytest
import scipy

from fieldkit.core.errors import ConfigurationError
from sim_backends.radio.core.links import LOST, OUT_OF_RANGE, QUEUE_FULL
from tests.helpers.radio_networks import MS, carry, fixed, network, packets, standing, wifi

STATES = standing({"a": (0.0, 0.0, 1.0), "b": (10.0, 0.0, 1.0)})
HEADERS_BYTES = 28


@pytest.mark.parametrize(("size_bytes", "fragments"), [(100, 1), (1472, 1), (1473, 2), (1480 * 5 - 8, 5)])
def test_a_datagram_is_lost_if_any_fragment_is_lost(size_bytes: int, fragments: int) -> None:
    """1 - (1 - p)^n, because fragments are lost independently."""
    loss, n = 0.1, 4000
    net = network(fixed(loss=f"{loss:.0%}"), "ab")
    sent_packets = packets([(number * MS, "a", "b", size_bytes) for number in range(n)])
    result = carry(net, STATES, sent_packets)
    interval = scipy.stats.binomtest(len(result.dropped), n).proportion_ci(confidence_level=0.99, method="wilson")
    assert interval.low <= 1 - (1 - loss) ** fragments <= interval.high
    assert set(result.dropped.values()) == {LOST}
    assert len(result.arrived) + len(result.dropped) == n


@pytest.mark.parametrize("size_bytes", [0, 1, 1472, 1473, 4000, 65507])
def test_the_delay_over_a_fixed_link_equals_the_closed_form(size_bytes: int) -> None:
    """Serialization of every fragment with its header, in sequence, and the delay of the last fragment."""
    net = network(fixed(delay="5ms", rate="12Mbit/s"), "ab")
    result = carry(net, STATES, packets([(7 * MS, "a", "b", size_bytes)]))
    fragments = max(-(-(size_bytes + 8) // 1480), 1)
    wire_bytes = size_bytes + 8 + 20 * fragments
    assert result.arrived == {("a to b", 0): pytest.approx(12 * MS + wire_bytes * 8 / 12e6 * 1e9, abs=fragments)}


def test_a_datagram_that_is_too_long_is_rejected() -> None:
    net = network(fixed(delay="5ms"), "ab")
    with pytest.raises(ConfigurationError, match=r"an IP packet of 65536 bytes is longer than 65535") as error:
        carry(net, STATES, packets([(0, "a", "b", 65508)]))
    assert "smaller" in error.value.remedy


def test_an_overflowing_queue_drops_exactly_the_excess_packets() -> None:
    # 1500 bytes at 12 Mbit/s take 1 ms; one packet is on the air, 10 wait, and 19 of 30 simultaneous packets are
    # dropped.
    net = network(fixed(rate="12Mbit/s", queue_packets=10), "ab")
    result = carry(net, STATES, packets([(0, "a", "b", 1500 - HEADERS_BYTES)] * 30))
    assert sorted(number for _, number in result.arrived) == list(range(11))
    assert result.dropped == {("a to b", number): QUEUE_FULL for number in range(11, 30)}


def test_a_queue_overflow_within_a_datagram_is_one_drop() -> None:
    net = network(fixed(rate="12Mbit/s", queue_packets=2), "ab")
    result = carry(net, STATES, packets([(0, "a", "b", 10_000), (100 * MS, "a", "b", 3000)]))
    assert result.dropped == {("a to b", 0): QUEUE_FULL}
    assert set(result.arrived) == {("a to b", 1)}


@pytest.mark.parametrize(("distance_m", "reason"), [(40.0, ""), (120.0, OUT_OF_RANGE)])
def test_a_station_out_of_range_receives_nothing(distance_m: float, reason: str) -> None:
    net = network(wifi("ab"), "ab")
    states = standing({"a": (0.0, 0.0, 1.0), "b": (distance_m, 0.0, 1.0)})
    result = carry(net, states, packets([(0, "a", "b", 100)]))
    assert result.dropped.get(("a to b", 0), "") == reason


def test_packets_of_an_agent_to_itself_arrive_immediately() -> None:
    net = network(wifi("ab"), "ab")
    assert carry(net, STATES, packets([(5, "a", "a", 5000)])).arrived == {("a to a", 0): 5}


def test_an_unknown_transport_is_rejected() -> None:
    net = network(wifi("ab"), "ab")
    with pytest.raises(ConfigurationError, match="no transport 'upd'") as error:
        carry(net, STATES, packets([(0, "a", "b", 5)], protocol="upd"))
    assert "udp" in error.value.remedy
