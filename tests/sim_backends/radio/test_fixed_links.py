"""The engine on a virtual clock, against closed forms."""

from collections import Counter
from collections.abc import Iterable
from itertools import permutations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import binomtest

from sim_backends.radio.delay import Delay
from sim_backends.radio.fixed_links import FixedLinks, _OnLink
from sim_backends.radio.links import LinkCounters, LinkParameters

MS = 1_000_000


class Traced(FixedLinks[int]):
    """It notes each packet that goes over a link, and what the link has counted by then, its fate among it."""

    def __init__(self, seed: int) -> None:
        super().__init__(seed)
        self.trace: list[tuple[int, int, str, str, LinkCounters]] = []

    def _transmit(self, now_ns: int, packet: _OnLink[int], before: Delay) -> None:
        super()._transmit(now_ns, packet, before)
        link, number, *_ = packet
        self.trace.append((now_ns, number, link.transmitter, link.receiver, link.counters))


def engine(parameters: LinkParameters, names: str = "ab", *, relay: str | None = None, seed: int = 1) -> Traced:
    made = Traced(seed)
    made.connect(dict.fromkeys(permutations(names, 2), parameters), relay)
    return made


def delivered(running: FixedLinks[int], now_ns: int) -> list[tuple[int, str, int]]:
    """Return when, at whom and which packets arrived up to `now_ns`."""
    return [(at_ns, name, number) for at_ns, name, number, _, _ in running.deliveries(now_ns)]


def drain(running: FixedLinks[int]) -> list[tuple[int, str, int]]:
    """Step from event to event until nothing is under way."""
    arrived = delivered(running, 0)
    while (at_ns := running.next_event_ns()) is not None:
        arrived += delivered(running, at_ns)
    return arrived


def test_a_plain_link_delivers_at_once() -> None:
    running = engine(LinkParameters())
    running.send(5, "a", 1, 100, "b")
    assert running.next_event_ns() is None
    assert delivered(running, 5) == [(5, "b", 1)]
    assert delivered(running, 5) == []


def test_delay_holds_a_packet_to_the_nanosecond() -> None:
    running = engine(LinkParameters(delay_ns=5 * MS))
    running.send(7, "a", 1, 100, "b")
    assert running.next_event_ns() == 5 * MS + 7
    assert delivered(running, 5 * MS + 6) == []
    assert delivered(running, 5 * MS + 7) == [(5 * MS + 7, "b", 1)]


def test_serialization_takes_bits_over_rate_and_packets_follow_each_other() -> None:
    # 1500 bytes at 12 Mbit/s take 1 ms.
    running = engine(LinkParameters(rate_bit_s=12_000_000, delay_ns=100))
    for number in range(3):
        running.send(0, "a", number, 1500, "b")
    assert [(at_ns, number) for at_ns, _, number in drain(running)] == [
        (MS + 100, 0),
        (2 * MS + 100, 1),
        (3 * MS + 100, 2),
    ]


def test_serialization_is_rounded_up() -> None:
    assert LinkParameters(rate_bit_s=3_000_000_000).serialization_ns(1) == 3


def test_directions_do_not_share_a_queue() -> None:
    running = engine(LinkParameters(rate_bit_s=12_000_000))
    running.send(0, "a", 1, 1500, "b")
    running.send(0, "b", 2, 1500, "a")
    assert {at_ns for at_ns, _, _ in drain(running)} == {MS}


@pytest.mark.parametrize("queue_packets", [0, 1, 10])
def test_queue_holds_its_bound_beside_the_packet_on_the_air(queue_packets: int) -> None:
    running = engine(LinkParameters(rate_bit_s=12_000_000, queue_packets=queue_packets))
    for number in range(20):
        running.send(0, "a", number, 1500, "b")
    assert [number for _, _, number in drain(running)] == list(range(queue_packets + 1))
    assert running.counters()["a", "b"].queue_dropped == 19 - queue_packets


def test_queue_empties_as_packets_go_on_the_air() -> None:
    running = engine(LinkParameters(rate_bit_s=12_000_000, queue_packets=1))
    # One goes out at 0 ms and one waits until 1 ms; a third finds the queue full before and room after.
    for at_ns, number in ((0, 0), (0, 1), (MS - 1, 2), (MS, 3)):
        running.send(at_ns, "a", number, 1500, "b")
    assert [number for _, _, number in drain(running)] == [0, 1, 3]


@pytest.mark.parametrize("loss", [0.0, 0.01, 0.1, 0.3, 1.0])
def test_loss_has_the_set_value_in_its_wilson_interval(loss: float) -> None:
    running, n = engine(LinkParameters(loss=loss)), 20_000
    for number in range(n):
        running.send(number, "a", number, 100, "b")
    lost = n - len(drain(running))
    interval = binomtest(lost, n).proportion_ci(confidence_level=0.99, method="wilson")
    assert interval.low <= loss <= interval.high
    assert running.counters()["a", "b"].lost == lost


def test_jitter_is_uniform_and_never_reorders() -> None:
    running, n = engine(LinkParameters(delay_ns=MS, jitter_ns=2 * MS)), 4000
    for number in range(n):
        running.send(number * 10 * MS, "a", number, 100, "b")
    extra_ns = [at_ns - number * 10 * MS - MS for at_ns, _, number in drain(running)]
    assert all(0 <= value < 2 * MS for value in extra_ns)
    # Four standard errors of the mean of a uniform of width 2 ms.
    assert sum(extra_ns) / n == pytest.approx(MS, abs=4 * 2 * MS / (12 * n) ** 0.5)
    for number in range(200):
        running.send(n * 10 * MS + number, "a", number, 100, "b")
    assert [number for _, _, number in drain(running)] == list(range(200))


def test_broadcast_reaches_everyone_else_with_a_fate_each() -> None:
    running, n = engine(LinkParameters(loss=0.5), "abcd"), 2000
    for number in range(n):
        running.send(number, "a", number, 100, None)
    reached: dict[str, set[int]] = {name: set() for name in "bcd"}
    for _, name, number in drain(running):
        reached[name].add(number)
    everyone = len(reached["b"] & reached["c"] & reached["d"])
    interval = binomtest(everyone, n).proportion_ci(confidence_level=0.99, method="wilson")
    assert interval.low <= 0.5**3 <= interval.high


def test_relay_takes_both_hops_and_only_the_destination_gets_the_packet() -> None:
    running = engine(LinkParameters(rate_bit_s=12_000_000, delay_ns=5 * MS), "abr", relay="r")
    running.send(0, "a", 1, 1500, "b")
    assert drain(running) == [(12 * MS, "b", 1)]
    counters = running.counters()
    assert [counters[pair].delivered for pair in (("a", "r"), ("r", "b"), ("a", "b"))] == [1, 1, 0]


def test_traffic_of_the_relay_itself_is_one_hop() -> None:
    running = engine(LinkParameters(delay_ns=5 * MS), "abr", relay="r")
    running.send(0, "a", 1, 100, "r")
    running.send(0, "r", 2, 100, "b")
    assert sorted(drain(running)) == [(5 * MS, "b", 2), (5 * MS, "r", 1)]


def test_relay_repeats_a_broadcast_to_everyone_but_its_sender() -> None:
    running = engine(LinkParameters(delay_ns=MS), "abcr", relay="r")
    running.send(0, "a", 1, 100, None)
    assert sorted(drain(running)) == [(MS, "r", 1), (2 * MS, "b", 1), (2 * MS, "c", 1)]


def test_loss_meets_a_relayed_packet_on_each_hop() -> None:
    running, n = engine(LinkParameters(loss=0.1), "abr", relay="r"), 20_000
    for number in range(n):
        running.send(number, "a", number, 100, "b")
    interval = binomtest(len(drain(running)), n).proportion_ci(confidence_level=0.99, method="wilson")
    assert interval.low <= 0.81 <= interval.high


def test_second_hop_starts_when_the_first_ended_however_late_the_caller_looks() -> None:
    running = engine(LinkParameters(delay_ns=5 * MS), "abr", relay="r")
    running.send(0, "a", 1, 100, "b")
    assert delivered(running, 60 * MS) == [(10 * MS, "b", 1)]


def test_packets_on_the_air_keep_their_fate_and_links_not_named_are_gone() -> None:
    running = engine(LinkParameters(delay_ns=5 * MS), "abr", relay="r")
    running.send(0, "a", 1, 100, "r")
    running.send(0, "a", 2, 100, "b")
    running.connect({("a", "r"): LinkParameters(), ("r", "a"): LinkParameters()}, None)
    assert drain(running) == [(5 * MS, "r", 1)]
    with pytest.raises(KeyError):
        running.send(6 * MS, "a", 3, 100, "b")


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


def play(running: FixedLinks[int], traffic: list[tuple[int, str, str | None, int]]) -> list[tuple[int, str, int]]:
    now_ns = 0
    for number, (wait_ns, source, destination, size_bytes) in enumerate(traffic):
        now_ns += wait_ns
        if source != destination:
            running.send(now_ns, source, number, size_bytes, destination)
    return drain(running)


@given(traffic=TRAFFIC, link=LINK, relay=st.sampled_from([None, "r"]))
def test_equal_seeds_give_equal_runs_in_order_of_time(
    traffic: list[tuple[int, str, str | None, int]], link: LinkParameters, relay: str | None
) -> None:
    one, other = (engine(link, "abr", relay=relay) for _ in range(2))
    arrived = play(one, traffic)
    assert arrived == play(other, traffic)
    assert one.trace == other.trace
    assert [at_ns for at_ns, _, _ in arrived] == sorted(at_ns for at_ns, _, _ in arrived)
    assert max(Counter((name, number) for _, name, number in arrived).values(), default=1) == 1
    for counters in one.counters().values():
        assert counters.sent == counters.lost + counters.delivered


def test_another_seed_gives_another_run() -> None:
    traffic: list[tuple[int, str, str | None, int]] = [(MS, "a", "b", 100)] * 50
    one, other = (engine(LinkParameters(loss=0.5), seed=seed) for seed in (1, 2))
    assert play(one, traffic) != play(other, traffic)
    assert one.trace != other.trace


def test_traffic_elsewhere_does_not_change_the_fate_of_a_link() -> None:
    def fates(with_traffic_elsewhere: bool) -> list[int]:
        running = engine(LinkParameters(loss=0.5), "abc")
        for number in range(500):
            if with_traffic_elsewhere:
                running.send(number, "c", -1, 100, "b")
            running.send(number, "a", number, 100, "b")
        return [number for _, _, number in drain(running) if number >= 0]

    assert fates(True) == fates(False)


@given(st.sets(st.integers(0, 199)))
def test_one_packet_less_changes_nothing_for_the_others(missing: set[int]) -> None:
    """Draws for loss and jitter are keyed by the packet, also beyond a relay."""

    def arrivals(numbers: Iterable[int]) -> dict[int, int]:
        running = engine(LinkParameters(loss=0.3, jitter_ns=MS), "abr", relay="r")
        for number in numbers:
            running.send(number * 10 * MS, "a", number, 100, "b", packet=("flow", number))
        return {number: at_ns for at_ns, _, number in drain(running)}

    whole = arrivals(range(200))
    assert 60 < len(whole) < 140
    assert arrivals(set(range(200)) - missing) == {
        number: at_ns for number, at_ns in whole.items() if number not in missing
    }
