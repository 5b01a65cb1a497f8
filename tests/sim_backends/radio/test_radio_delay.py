"""The four parts of each packet's delay, on a virtual clock, against closed forms."""

from itertools import permutations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.model import DelayParts
from sim_backends.radio import delay
from sim_backends.radio.delay import Delivery
from sim_backends.radio.fixed_links import FixedLinks
from sim_backends.radio.links import LinkParameters
from sim_backends.radio.modes import G_MODES
from sim_backends.radio.wifi import Wifi
from tests.helpers.stations import FixedPowers

MS = 1_000_000
LINK = st.builds(
    LinkParameters,
    rate_bit_s=st.sampled_from([None, 1_000_000, 54_000_000]),
    delay_ns=st.integers(MS, 2 * MS),
    jitter_ns=st.sampled_from([0, MS]),
    loss=st.sampled_from([0.0, 0.3]),
    queue_packets=st.integers(0, 5),
)
SENT = st.tuples(st.integers(0, 3 * MS), st.sampled_from("abr"), st.sampled_from("abr*"), st.integers(20, 1500))


def engine(link: LinkParameters, relay: str | None = None) -> FixedLinks[int]:
    made: FixedLinks[int] = FixedLinks(1)
    made.connect(dict.fromkeys(permutations("abr", 2), link), relay)
    return made


def drain(running: FixedLinks[int]) -> list[Delivery[int]]:
    arrived = running.deliveries(0)
    while (at_ns := running.next_event_ns()) is not None:
        arrived += running.deliveries(at_ns)
    return arrived


def burst(link: LinkParameters, packets: int, relay: str | None = None) -> DelayParts:
    """Return the parts over what arrives at b of packets of 1,500 bytes that a sends at once."""
    running = engine(link, relay)
    for number in range(packets):
        running.send(0, "a", number, 1500, "b")
    return delay.parts(sum(delayed for _, _, _, _, delayed in drain(running)))


@pytest.mark.parametrize("packets", [1, 2, 7, 1000])
def test_in_a_burst_packets_wait_for_those_before_them(packets: int) -> None:
    # 1500 bytes at 12 Mbit/s take 1 ms, so that packet k waits k ms: (n - 1)/2 ms in the mean.
    link = LinkParameters(rate_bit_s=12_000_000, delay_ns=5 * MS)
    assert burst(link, packets) == DelayParts(
        packets=packets,
        processing_ns=0,
        transmission_ns=packets * MS,
        propagation_ns=packets * 5 * MS,
        queuing_ns=packets * (packets - 1) // 2 * MS,
    )


def test_both_hops_of_a_relayed_packet_count() -> None:
    # Packets reach the relay one transmission apart, just as fast as it sends them on: none waits there.
    link = LinkParameters(rate_bit_s=12_000_000, delay_ns=5 * MS)
    assert burst(link, 10, relay="r") == DelayParts(
        packets=10,
        processing_ns=0,
        transmission_ns=10 * 2 * MS,
        propagation_ns=10 * 10 * MS,
        queuing_ns=45 * MS,
    )


def test_what_the_queue_drops_counts_for_nothing() -> None:
    parts = burst(LinkParameters(rate_bit_s=12_000_000, queue_packets=3), 20)
    assert (parts.packets, parts.transmission_ns, parts.queuing_ns) == (4, 4 * MS, 6 * MS)


def test_what_is_lost_on_either_hop_counts_for_nothing() -> None:
    running = engine(LinkParameters(loss=0.5, delay_ns=MS), "r")
    for number in range(200):
        running.send(0, "a", number, 1500, "b")
    arrived = drain(running)
    parts = delay.parts(sum(delayed for _, _, _, _, delayed in arrived))
    assert 0 < parts.packets == len(arrived) < running.counters()["a", "r"].delivered
    assert parts.propagation_ns == len(arrived) * 2 * MS


def test_jitter_and_waiting_for_its_turn_are_of_the_way() -> None:
    running = engine(LinkParameters(delay_ns=MS, jitter_ns=2 * MS))
    for number in range(100):
        running.send(number, "a", number, 1500, "b")
    for at_ns, _, number, _, delayed in drain(running):
        assert delay.parts(delayed) == DelayParts(
            packets=1, processing_ns=0, transmission_ns=0, propagation_ns=at_ns - number, queuing_ns=0
        )


@given(traffic=st.lists(SENT, max_size=60), links=st.tuples(LINK, LINK), relay=st.sampled_from([None, "r"]))
def test_the_parts_are_all_of_the_time_from_sending_to_arriving(
    traffic: list[tuple[int, str, str, int]], links: tuple[LinkParameters, LinkParameters], relay: str | None
) -> None:
    running, now_ns, sent_ns = engine(links[0], relay), 0, []
    for number, (wait_ns, source, destination, size_bytes) in enumerate(traffic):
        if number == len(traffic) // 2:
            running.connect(dict.fromkeys(permutations("abr", 2), links[1]), relay)
        now_ns += wait_ns
        sent_ns.append((source, now_ns))
        if source != destination:
            running.send(now_ns, source, number, size_bytes, None if destination == "*" else destination)
    for at_ns, _, number, source, delayed in drain(running):
        parts = delay.parts(delayed)
        took_ns = parts.processing_ns + parts.transmission_ns + parts.propagation_ns + parts.queuing_ns
        assert (source, at_ns - took_ns, parts.packets) == (*sent_ns[number], 1)


@pytest.mark.parametrize("relay", [None, "r"])
@pytest.mark.parametrize("destination", ["b", None])
def test_what_a_packet_was_delayed_by_before_is_a_part_of_it(relay: str | None, destination: str | None) -> None:
    wifi: Wifi[int] = Wifi(FixedPowers("abr", G_MODES[-1]), 1)
    wifi.relay(relay)
    fixed = engine(LinkParameters(delay_ns=MS), relay)
    for model in (wifi, fixed):
        model.send(0, "a", 0, 1000, destination, before=delay.PACKET + 7 * delay.PROCESSING_NS)
        arrived = model.deliveries(10**9)
        assert arrived
        for at_ns, _, _, _, delayed in arrived:
            parts = delay.parts(delayed)
            assert (parts.packets, parts.processing_ns, delay.processing_ns(delayed)) == (1, 7, 7)
            assert parts.transmission_ns + parts.propagation_ns + parts.queuing_ns == at_ns


PARTS = st.builds(
    DelayParts,
    **dict.fromkeys(
        ("packets", "processing_ns", "transmission_ns", "propagation_ns", "queuing_ns"), st.integers(0, 2**55)
    ),
)


@given(st.lists(PARTS, max_size=100))
def test_delays_add_up_part_by_part(several: list[DelayParts]) -> None:
    total = sum(
        one.packets * delay.PACKET
        + one.processing_ns * delay.PROCESSING_NS
        + one.transmission_ns * delay.TRANSMISSION_NS
        + one.propagation_ns * delay.PROPAGATION_NS
        + one.queuing_ns * delay.QUEUING_NS
        for one in several
    )
    assert vars(delay.parts(total)) == {
        name: sum(getattr(one, name) for one in several) for name in DelayParts.__dataclass_fields__
    }
