"""The four parts of each packet's delay in virtual time, compared with closed-form results."""

from itertools import permutations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.model import DelayParts
from sim_backends.radio.core.links import (
    PACKET,
    PROCESSING_NS,
    PROPAGATION_NS,
    QUEUING_NS,
    TRANSMISSION_NS,
    Delivery,
    LinkParameters,
    delay_parts,
    processing_ns,
)
from sim_backends.radio.models.fixed_links import FixedLinks
from sim_backends.radio.phy.modes import G_MODES
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
REQUEST = st.tuples(st.integers(0, 3 * MS), st.sampled_from("abr"), st.sampled_from("abr*"), st.integers(20, 1500))


def make_links(link: LinkParameters, relay: str | None = None) -> FixedLinks[int]:
    links: FixedLinks[int] = FixedLinks(1)
    links.connect(dict.fromkeys(permutations("abr", 2), link), relay)
    return links


def drain(links: FixedLinks[int]) -> list[Delivery[int]]:
    deliveries = links.deliveries(0)
    while (at_ns := links.next_event_ns()) is not None:
        deliveries += links.deliveries(at_ns)
    return deliveries


def delays_of_burst(link: LinkParameters, packets: int, relay: str | None = None) -> DelayParts:
    """Return the delay parts at b of a burst of packets of 1,500 bytes sent by a."""
    links = make_links(link, relay)
    for number in range(packets):
        links.send(0, "a", number, 1500, "b")
    return delay_parts(sum(delay_sum for _, _, _, _, delay_sum in drain(links)))


@pytest.mark.parametrize("packets", [1, 2, 7, 1000])
def test_packets_of_a_burst_wait_for_earlier_ones(packets: int) -> None:
    # 1500 bytes at 12 Mbit/s take 1 ms, so that packet k waits k ms: (n - 1)/2 ms in the mean.
    link = LinkParameters(rate_bit_s=12_000_000, delay_ns=5 * MS)
    assert delays_of_burst(link, packets) == DelayParts(
        packets=packets,
        processing_ns=0,
        transmission_ns=packets * MS,
        propagation_ns=packets * 5 * MS,
        queuing_ns=packets * (packets - 1) // 2 * MS,
    )


def test_the_delay_of_a_relayed_packet_includes_both_hops() -> None:
    # Packets arrive at the relay one transmission time apart, at the rate at which it forwards them: none waits
    # there.
    link = LinkParameters(rate_bit_s=12_000_000, delay_ns=5 * MS)
    assert delays_of_burst(link, 10, relay="r") == DelayParts(
        packets=10,
        processing_ns=0,
        transmission_ns=10 * 2 * MS,
        propagation_ns=10 * 10 * MS,
        queuing_ns=45 * MS,
    )


def test_dropped_packets_do_not_add_to_the_delay() -> None:
    parts = delays_of_burst(LinkParameters(rate_bit_s=12_000_000, queue_packets=3), 20)
    assert (parts.packets, parts.transmission_ns, parts.queuing_ns) == (4, 4 * MS, 6 * MS)


def test_lost_packets_do_not_add_to_the_delay() -> None:
    links = make_links(LinkParameters(loss=0.5, delay_ns=MS), "r")
    for number in range(200):
        links.send(0, "a", number, 1500, "b")
    deliveries = drain(links)
    parts = delay_parts(sum(delay_sum for _, _, _, _, delay_sum in deliveries))
    assert 0 < parts.packets == len(deliveries) < links.counters()["a", "r"].delivered
    assert parts.propagation_ns == len(deliveries) * 2 * MS


def test_jitter_and_reordering_wait_count_as_propagation() -> None:
    links = make_links(LinkParameters(delay_ns=MS, jitter_ns=2 * MS))
    for number in range(100):
        links.send(number, "a", number, 1500, "b")
    for at_ns, _, number, _, delay_sum in drain(links):
        assert delay_parts(delay_sum) == DelayParts(
            packets=1, processing_ns=0, transmission_ns=0, propagation_ns=at_ns - number, queuing_ns=0
        )


@given(traffic=st.lists(REQUEST, max_size=60), parameters=st.tuples(LINK, LINK), relay=st.sampled_from([None, "r"]))
def test_the_parts_add_up_to_the_time_from_sending_to_arrival(
    traffic: list[tuple[int, str, str, int]], parameters: tuple[LinkParameters, LinkParameters], relay: str | None
) -> None:
    links, now_ns, sent_ns = make_links(parameters[0], relay), 0, []
    for number, (wait_ns, source, destination, size_bytes) in enumerate(traffic):
        if number == len(traffic) // 2:
            links.connect(dict.fromkeys(permutations("abr", 2), parameters[1]), relay)
        now_ns += wait_ns
        sent_ns.append((source, now_ns))
        if source != destination:
            links.send(now_ns, source, number, size_bytes, None if destination == "*" else destination)
    for at_ns, _, number, source, delay_sum in drain(links):
        parts = delay_parts(delay_sum)
        total_ns = parts.processing_ns + parts.transmission_ns + parts.propagation_ns + parts.queuing_ns
        assert (source, at_ns - total_ns, parts.packets) == (*sent_ns[number], 1)


@pytest.mark.parametrize("relay", [None, "r"])
@pytest.mark.parametrize("destination", ["b", None])
def test_the_delay_includes_the_delay_before_the_radio(relay: str | None, destination: str | None) -> None:
    wifi: Wifi[int] = Wifi(FixedPowers("abr", G_MODES[-1]), 1)
    wifi.set_relay(relay)
    fixed = make_links(LinkParameters(delay_ns=MS), relay)
    for model in (wifi, fixed):
        model.send(0, "a", 0, 1000, destination, before=PACKET + 7 * PROCESSING_NS)
        deliveries = model.deliveries(10**9)
        assert deliveries
        for at_ns, _, _, _, delay_sum in deliveries:
            parts = delay_parts(delay_sum)
            assert (parts.packets, parts.processing_ns, processing_ns(delay_sum)) == (1, 7, 7)
            assert parts.transmission_ns + parts.propagation_ns + parts.queuing_ns == at_ns


PARTS = st.builds(
    DelayParts,
    **dict.fromkeys(
        ("packets", "processing_ns", "transmission_ns", "propagation_ns", "queuing_ns"), st.integers(0, 2**55)
    ),
)


@given(st.lists(PARTS, max_size=100))
def test_parts_of_delays_are_summed_separately(all_parts: list[DelayParts]) -> None:
    total = sum(
        parts.packets * PACKET
        + parts.processing_ns * PROCESSING_NS
        + parts.transmission_ns * TRANSMISSION_NS
        + parts.propagation_ns * PROPAGATION_NS
        + parts.queuing_ns * QUEUING_NS
        for parts in all_parts
    )
    names = ("packets", "processing_ns", "transmission_ns", "propagation_ns", "queuing_ns")
    sums = {name: sum(getattr(parts, name) for parts in all_parts) for name in names}
    assert delay_parts(total) == DelayParts(**sums)
