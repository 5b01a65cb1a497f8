"""Delays of single flows, with packets built byte by byte: each is counted for its flow, whatever is lost."""

import struct
from collections import Counter
from ipaddress import IPv4Address

from hypothesis import given
from hypothesis import strategies as st

from sim_backends.emulated.medium.ports import FlowDelays
from sim_backends.radio.links import PACKET, QUEUING_NS
from tests.helpers.captures import RECEIVER, SENDER, datagram, ipv4

UDP, TCP = 17, 6
SENDER_ADDRESS, RECEIVER_ADDRESS = IPv4Address(SENDER), IPv4Address(RECEIVER)


def count_of(flows: FlowDelays, port: int, protocol: int = UDP) -> int:
    return flows.delay_parts(SENDER_ADDRESS, RECEIVER_ADDRESS, protocol, port).packets


@given(
    sent=st.lists(st.tuples(st.integers(0, 3), st.sampled_from([1234, 1235]), st.integers(1, 9000)), max_size=30),
    lost=st.sets(st.integers(0, 100)),
)
def test_every_fragment_that_arrives_is_counted_for_its_flow(
    sent: list[tuple[int, int, int]], lost: set[int]
) -> None:
    """Identifications are reused immediately, also by another flow; any packet may be lost, also the first."""
    flows = FlowDelays()
    assert count_of(flows, 1234) == 0
    truth: Counter[int] = Counter()
    number = 0
    for ip_id, port, size in sent:
        packets = datagram(ip_id, size, port=port)
        for packet in packets:
            flows.note_first_fragment(packet)
        for packet in packets:
            number += 1
            if number not in lost:
                flows.count(packet, PACKET, RECEIVER_ADDRESS.packed)
                truth[port] += 1
    assert count_of(flows, 1234) == truth[1234]
    assert count_of(flows, 1235) == 0, "it is counted from the first request"


def test_protocol_direction_and_options_of_the_header_matter() -> None:
    flows = FlowDelays()
    for protocol in (UDP, TCP):
        assert count_of(flows, 1234, protocol) == 0
    head = struct.pack(">HHI", 40_000, 1234, 0)
    plain = ipv4(head, protocol=TCP)
    # A header of 24 bytes, whose option looks like another port.
    optional = bytes((0x46,)) + plain[1:20] + struct.pack(">HH", 7, 7) + plain[20:]
    for packet in (plain, optional, ipv4(head, protocol=TCP, src=RECEIVER, dst=SENDER), ipv4(head, protocol=1)):
        flows.note_first_fragment(packet)
        flows.count(packet, PACKET, packet[16:20])
    assert (count_of(flows, 1234, TCP), count_of(flows, 1234)) == (2, 0)


def test_a_packet_that_is_forwarded_counts_once_with_the_time_of_all_its_hops() -> None:
    flows = FlowDelays()
    assert count_of(flows, 1234) == 0
    (packet,) = datagram(1, 100, port=1234)
    # Another time to live on each hop, as forwarding has it.
    hops = [packet[:8] + bytes((64 - number,)) + packet[9:] for number in range(3)]
    for hop, receiver in zip(hops, (b"\x0a\x2a\x00\x07", b"\x0a\x2a\x00\x08", RECEIVER_ADDRESS.packed), strict=True):
        flows.note_first_fragment(hop)
        flows.count(hop, PACKET + QUEUING_NS * 1000, receiver)
    parts = flows.delay_parts(SENDER_ADDRESS, RECEIVER_ADDRESS, UDP, 1234)
    assert (parts.packets, parts.queuing_ns) == (1, 3000)
