"""UDP over links that can be worked out on paper: loss of fragments, delay, queues, range, hidden stations."""

import pytest
from scipy.stats import binomtest

from fieldkit.core.errors import ConfigurationError
from sim_backends.radio.losses import LOST, OUT_OF_RANGE, QUEUE_FULL
from tests.helpers.radio_networks import MS, carry, fixed, network, packets, standing, wifi

HERE = standing({"a": (0.0, 0.0, 1.0), "b": (10.0, 0.0, 1.0)})
HEADERS_BYTES = 28


@pytest.mark.parametrize(("size_bytes", "fragments"), [(100, 1), (1472, 1), (1473, 2), (1480 * 5 - 8, 5)])
def test_a_datagram_is_lost_with_any_of_its_fragments(size_bytes: int, fragments: int) -> None:
    """1 - (1 - p)^n, each fragment having a fate of its own."""
    loss, n = 0.1, 4000
    net = network(fixed(loss=f"{loss:.0%}"), "ab")
    sent = packets([(number * MS, "a", "b", size_bytes) for number in range(n)])
    found = carry(net, HERE, sent)
    interval = binomtest(len(found.dropped), n).proportion_ci(confidence_level=0.99, method="wilson")
    assert interval.low <= 1 - (1 - loss) ** fragments <= interval.high
    assert set(found.dropped.values()) == {LOST}
    assert len(found.arrived) + len(found.dropped) == n


@pytest.mark.parametrize("size_bytes", [0, 1, 1472, 1473, 4000, 65507])
def test_delay_over_a_fixed_link_in_closed_form(size_bytes: int) -> None:
    """Serialization of every fragment with its own header, one after the other, and the delay of the last."""
    net = network(fixed(delay="5ms", rate="12Mbit/s"), "ab")
    found = carry(net, HERE, packets([(7 * MS, "a", "b", size_bytes)]))
    fragments = max(-(-(size_bytes + 8) // 1480), 1)
    wire_bytes = size_bytes + 8 + 20 * fragments
    assert found.arrived == {("a to b", 0): pytest.approx(12 * MS + wire_bytes * 8 / 12e6 * 1e9, abs=fragments)}


def test_a_datagram_that_is_too_long_is_refused() -> None:
    net = network(fixed(delay="5ms"), "ab")
    with pytest.raises(ConfigurationError, match=r"an IP packet of 65536 bytes is longer than 65535") as error:
        carry(net, HERE, packets([(0, "a", "b", 65508)]))
    assert "smaller" in error.value.remedy


def test_a_queue_that_overflows_drops_exactly_what_does_not_fit() -> None:
    # 1500 bytes at 12 Mbit/s take 1 ms; one is on the air, 10 wait, and of 30 at once 19 are one too many.
    net = network(fixed(rate="12Mbit/s", queue_packets=10), "ab")
    found = carry(net, HERE, packets([(0, "a", "b", 1500 - HEADERS_BYTES)] * 30))
    assert sorted(number for _, number in found.arrived) == list(range(11))
    assert found.dropped == {("a to b", number): QUEUE_FULL for number in range(11, 30)}


def test_a_queue_that_overflows_within_a_datagram_drops_it_once() -> None:
    net = network(fixed(rate="12Mbit/s", queue_packets=2), "ab")
    found = carry(net, HERE, packets([(0, "a", "b", 10_000), (100 * MS, "a", "b", 3000)]))
    assert found.dropped == {("a to b", 0): QUEUE_FULL}
    assert set(found.arrived) == {("a to b", 1)}


@pytest.mark.parametrize(("apart_m", "reason"), [(40.0, ""), (120.0, OUT_OF_RANGE)])
def test_who_is_out_of_range_gets_nothing(apart_m: float, reason: str) -> None:
    net = network(wifi("ab"), "ab")
    states = standing({"a": (0.0, 0.0, 1.0), "b": (apart_m, 0.0, 1.0)})
    found = carry(net, states, packets([(0, "a", "b", 100)]))
    assert found.dropped.get(("a to b", 0), "") == reason


def test_what_an_agent_sends_to_itself_arrives_at_once() -> None:
    net = network(wifi("ab"), "ab")
    assert carry(net, HERE, packets([(5, "a", "a", 5000)])).arrived == {("a to a", 0): 5}


def test_a_transport_that_is_not_there_is_refused() -> None:
    net = network(wifi("ab"), "ab")
    with pytest.raises(ConfigurationError, match="no transport 'upd'") as error:
        carry(net, HERE, packets([(0, "a", "b", 5)], protocol="upd"))
    assert "udp" in error.value.remedy
