"""Fixed links in virtual time, compared with closed-form results."""

from collections import Counter
from collections.abc import Iterable
from itertools import permutations

import pytest
import scipy
from hypothesis import given
from hypothesis import strategies as st

from sim_backends.radio.core.links import Delay, LinkCounters, LinkParameters
from sim_backends.radio.models.fixed_links import FixedLinks, _LinkPacket

MS = 1_000_000


class TracedLinks(FixedLinks[int]):
    """Fixed links that record each packet on a link, and the link's counters after it."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.trace: list[tuple[int, int, str, str, LinkCounters]] = []

    def _transmit(self, now_ns: int, packet: _LinkPacket[int], before: Delay) -> None:
        super()._transmit(now_ns, packet, before)
        link, number, *_ = packet
        self.trace.append((now_ns, number, link.transmitter, link.receiver, link.counters))


def make_links(
    parameters: LinkParameters, names: str = "ab", *, relay: str | None = None, seed: int = 1
) -> TracedLinks:
    links = TracedLinks(seed)
    links.connect(dict.fromkeys(permutations(names, 2), parameters), relay)
    return links


def list_deliveries(links: FixedLinks[int], now_ns: int) -> list[tuple[int, str, int]]:
    """Return time, receiver and number of each packet that arrived up to `now_ns`."""
    return [(at_ns, name, number) for at_ns, name, number, _, _ in links.deliveries(now_ns)]


def drain(links: FixedLinks[int]) -> list[tuple[int, str, int]]:
    """Advance from event to event until no packet is in flight."""
    deliveries = list_deliveries(links, 0)
    while (at_ns := links.next_event_ns()) is not None:
        deliveries += list_deliveries(links, at_ns)
    return deliveries


def test_a_link_without_delay_delivers_immediately() -> None:
    links = make_links(LinkParameters())
    links.send(5, "a", 1, 100, "b")
    assert links.next_event_ns() is None
    assert list_deliveries(links, 5) == [(5, "b", 1)]
    assert list_deliveries(links, 5) == []


def test_a_delay_is_exact_to_the_nanosecond() -> None:
    links = make_links(LinkParameters(delay_ns=5 * MS))
    links.send(7, "a", 1, 100, "b")
    assert links.next_event_ns() == 5 * MS + 7
    assert list_deliveries(links, 5 * MS + 6) == []
    assert list_deliveries(links, 5 * MS + 7) == [(5 * MS + 7, "b", 1)]


def test_serialization_takes_bits_over_rate_and_packets_are_sent_in_sequence() -> None:
    # 1500 bytes at 12 Mbit/s take 1 ms.
    links = make_links(LinkParameters(rate_bit_s=12_000_000, delay_ns=100))
    for number in range(3):
        links.send(0, "a", number, 1500, "b")
    assert [(at_ns, number) for at_ns, _, number in drain(links)] == [
        (MS + 100, 0),
        (2 * MS + 100, 1),
        (3 * MS + 100, 2),
    ]


def test_serialization_is_rounded_up() -> None:
    assert LinkParameters(rate_bit_s=3_000_000_000).serialization_ns(1) == 3


def test_directions_do_not_share_a_queue() -> None:
    links = make_links(LinkParameters(rate_bit_s=12_000_000))
    links.send(0, "a", 1, 1500, "b")
    links.send(0, "b", 2, 1500, "a")
    assert {at_ns for at_ns, _, _ in drain(links)} == {MS}


@pytest.mark.parametrize("queue_packets", [0, 1, 10])
def test_the_bound_of_a_queue_excludes_the_packet_on_the_air(queue_packets: int) -> None:
    links = make_links(LinkParameters(rate_bit_s=12_000_000, queue_packets=queue_packets))
    for number in range(20):
        links.send(0, "a", number, 1500, "b")
    assert [number for _, _, number in drain(links)] == list(range(queue_packets + 1))
    assert links.counters()["a", "b"].queue_dropped == 19 - queue_packets


def test_a_queue_has_space_when_transmission_of_its_packet_starts() -> None:
    links = make_links(LinkParameters(rate_bit_s=12_000_000, queue_packets=1))
    # One packet is sent at 0 ms and one waits until 1 ms; the queue is full for a third packet before that time only.
    for at_ns, number in ((0, 0), (0, 1), (MS - 1, 2), (MS, 3)):
        links.send(at_ns, "a", number, 1500, "b")
    assert [number for _, _, number in drain(links)] == [0, 1, 3]


@pytest.mark.parametrize("loss", [0.0, 0.01, 0.1, 0.3, 1.0])
def test_the_configured_loss_is_in_the_wilson_interval(loss: float) -> None:
    links, n = make_links(LinkParameters(loss=loss)), 20_000
    for number in range(n):
        links.send(number, "a", number, 100, "b")
    lost_count = n - len(drain(links))
    interval = scipy.stats.binomtest(lost_count, n).proportion_ci(confidence_level=0.99, method="wilson")
    assert interval.low <= loss <= interval.high
    assert links.counters()["a", "b"].lost == lost_count


def test_jitter_is_uniform_and_never_reorders() -> None:
    links, n = make_links(LinkParameters(delay_ns=MS, jitter_ns=2 * MS)), 4000
    for number in range(n):
        links.send(number * 10 * MS, "a", number, 100, "b")
    extra_ns = [at_ns - number * 10 * MS - MS for at_ns, _, number in drain(links)]
    assert all(0 <= value < 2 * MS for value in extra_ns)
    # Four standard errors of the mean of a uniform of width 2 ms.
    assert sum(extra_ns) / n == pytest.approx(MS, abs=4 * 2 * MS / (12 * n) ** 0.5)
    for number in range(200):
        links.send(n * 10 * MS + number, "a", number, 100, "b")
    assert [number for _, _, number in drain(links)] == list(range(200))


def test_losses_of_a_broadcast_are_independent_per_receiver() -> None:
    links, n = make_links(LinkParameters(loss=0.5), "abcd"), 2000
    for number in range(n):
        links.send(number, "a", number, 100, None)
    numbers_by_receiver: dict[str, set[int]] = {name: set() for name in "bcd"}
    for _, name, number in drain(links):
        numbers_by_receiver[name].add(number)
    received_by_all = len(numbers_by_receiver["b"] & numbers_by_receiver["c"] & numbers_by_receiver["d"])
    interval = scipy.stats.binomtest(received_by_all, n).proportion_ci(confidence_level=0.99, method="wilson")
    assert interval.low <= 0.5**3 <= interval.high


def test_a_relayed_packet_takes_two_hops_and_only_the_destination_receives_it() -> None:
    links = make_links(LinkParameters(rate_bit_s=12_000_000, delay_ns=5 * MS), "abr", relay="r")
    links.send(0, "a", 1, 1500, "b")
    assert drain(links) == [(12 * MS, "b", 1)]
    counters = links.counters()
    assert [counters[pair].delivered for pair in (("a", "r"), ("r", "b"), ("a", "b"))] == [1, 1, 0]


def test_traffic_of_the_relay_itself_is_one_hop() -> None:
    links = make_links(LinkParameters(delay_ns=5 * MS), "abr", relay="r")
    links.send(0, "a", 1, 100, "r")
    links.send(0, "r", 2, 100, "b")
    assert sorted(drain(links)) == [(5 * MS, "b", 2), (5 * MS, "r", 1)]


def test_a_relay_repeats_a_broadcast_to_all_stations_except_its_sender() -> None:
    links = make_links(LinkParameters(delay_ns=MS), "abcr", relay="r")
    links.send(0, "a", 1, 100, None)
    assert sorted(drain(links)) == [(MS, "r", 1), (2 * MS, "b", 1), (2 * MS, "c", 1)]


def test_loss_applies_to_each_hop_of_a_relayed_packet() -> None:
    links, n = make_links(LinkParameters(loss=0.1), "abr", relay="r"), 20_000
    for number in range(n):
        links.send(number, "a", number, 100, "b")
    interval = scipy.stats.binomtest(len(drain(links)), n).proportion_ci(confidence_level=0.99, method="wilson")
    assert interval.low <= 0.81 <= interval.high


def test_the_second_hop_starts_when_the_first_ends_even_if_deliveries_is_called_late() -> None:
    links = make_links(LinkParameters(delay_ns=5 * MS), "abr", relay="r")
    links.send(0, "a", 1, 100, "b")
    assert list_deliveries(links, 60 * MS) == [(10 * MS, "b", 1)]


def test_reconnecting_keeps_packets_in_flight_and_removes_unnamed_links() -> None:
    links = make_links(LinkParameters(delay_ns=5 * MS), "abr", relay="r")
    links.send(0, "a", 1, 100, "r")
    links.send(0, "a", 2, 100, "b")
    links.connect({("a", "r"): LinkParameters(), ("r", "a"): LinkParameters()}, None)
    assert drain(links) == [(5 * MS, "r", 1)]
    with pytest.raises(KeyError):
        links.send(6 * MS, "a", 3, 100, "b")


TRAFFIC = st.lists(
    st.tuples(
        st.integers(0, 3 * MS), st.sampled_from("abr"), st.sampled_from(["a", "b", "r", None]), st.integers(20, 1500)
    ),
    max_size=60,
)
LINK = st.builds(
    LinkParameters,
    rate_bit_s=st.sampled_from([None, 1_000_000, 54_000_000]),
    delay_ns=st.integers(0, 2 * MS),
    jitter_ns=st.sampled_from([0, MS]),
    loss=st.sampled_from([0.0, 0.3]),
    queue_packets=st.integers(0, 5),
)


def run_traffic(
    links: FixedLinks[int], traffic: list[tuple[int, str, str | None, int]]
) -> list[tuple[int, str, int]]:
    now_ns = 0
    for number, (wait_ns, source, destination, size_bytes) in enumerate(traffic):
        now_ns += wait_ns
        if source != destination:
            links.send(now_ns, source, number, size_bytes, destination)
    return drain(links)


@given(traffic=TRAFFIC, link=LINK, relay=st.sampled_from([None, "r"]))
def test_equal_seeds_give_equal_runs_in_order_of_time(
    traffic: list[tuple[int, str, str | None, int]], link: LinkParameters, relay: str | None
) -> None:
    first, second = (make_links(link, "abr", relay=relay) for _ in range(2))
    deliveries = run_traffic(first, traffic)
    assert deliveries == run_traffic(second, traffic)
    assert first.trace == second.trace
    assert [at_ns for at_ns, _, _ in deliveries] == sorted(at_ns for at_ns, _, _ in deliveries)
    assert max(Counter((name, number) for _, name, number in deliveries).values(), default=1) == 1
    for counters in first.counters().values():
        assert counters.sent == counters.lost + counters.delivered


def test_different_seeds_give_different_runs() -> None:
    traffic: list[tuple[int, str, str | None, int]] = [(MS, "a", "b", 100)] * 50
    first, second = (make_links(LinkParameters(loss=0.5), seed=seed) for seed in (1, 2))
    assert run_traffic(first, traffic) != run_traffic(second, traffic)
    assert first.trace != second.trace


def test_other_traffic_does_not_change_the_losses_of_a_link() -> None:
    def delivered_numbers(with_traffic_elsewhere: bool) -> list[int]:
        links = make_links(LinkParameters(loss=0.5), "abc")
        for number in range(500):
            if with_traffic_elsewhere:
                links.send(number, "c", -1, 100, "b")
            links.send(number, "a", number, 100, "b")
        return [number for _, _, number in drain(links) if number >= 0]

    assert delivered_numbers(True) == delivered_numbers(False)


@given(st.sets(st.integers(0, 199)))
def test_a_missing_packet_does_not_change_the_others(missing_numbers: set[int]) -> None:
    """Draws for loss and jitter are keyed by the packet, also behind a relay."""

    def arrivals(numbers: Iterable[int]) -> dict[int, int]:
        links = make_links(LinkParameters(loss=0.3, jitter_ns=MS), "abr", relay="r")
        for number in numbers:
            links.send(number * 10 * MS, "a", number, 100, "b", packet=("flow", number))
        return {number: at_ns for at_ns, _, number in drain(links)}

    all_arrivals = arrivals(range(200))
    assert 60 < len(all_arrivals) < 140
    assert arrivals(set(range(200)) - missing_numbers) == {
        number: at_ns for number, at_ns in all_arrivals.items() if number not in missing_numbers
    }
