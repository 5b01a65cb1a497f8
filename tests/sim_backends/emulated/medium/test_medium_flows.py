"""Delays of single flows: each packet is counted for its flow, whichever packets are lost."""

import struct
from collections import Counter
from ipaddress import IPv4Address

from hypothesis import given
from hypothesis import strategies as st

from sim_backends.emulated.medium.ports import FlowDelays
from sim_backends.radio.core.links import PACKET, QUEUING_NS
from tests.helpers.captures import RECEIVER, SENDER, datagram, ipv4

UDP, TCP = 17, 6
SENDER_ADDRESS, RECEIVER_ADDRESS = IPv4Address(SENDER), IPv4Address(RECEIVER)


def packet_count(flows: FlowDelays, port: int, protocol: int = UDP) -> int:
    return flows.delay_parts(SENDER_ADDRESS, RECEIVER_ADDRESS, protocol, port).packets


@given(
    datagrams=st.lists(
        st.tuples(st.integers(0, 3), st.sampled_from([1234, 1235]), st.integers(1, 9000)), max_size=30
    ),
    lost_numbers=st.sets(st.integers(0, 100)),
)
def test_every_fragment_that_arrives_is_counted_for_its_flow(
    datagrams: list[tuple[int, int, int]], lost_numbers: set[int]
) -> None:
    """Identifications are reused immediately, also by another flow; any fragment may be lost, also the first one."""
    flows = FlowDelays()
    assert packet_count(flows, 1234) == 0
    expected_counts: Counter[int] = Counter()
    number = 0
    for ip_id, port, size in datagrams:
        packets = datagram(ip_id, size, port=port)
        for packet in packets:
            flows.note_first_fragment(packet)
        for packet in packets:
            number += 1
            if number not in lost_numbers:
                flows.count(packet, PACKET, RECEIVER_ADDRESS.packed)
                expected_counts[port] += 1
    assert packet_count(flows, 1234) == expected_counts[1234]
    assert packet_count(flows, 1235) == 0, "packets of a flow are counted only after the first request"


def test_packets_are_counted_by_protocol_and_direction_and_header_options_are_skipped() -> None:
    flows = FlowDelays()
    for protocol in (UDP, TCP):
        assert packet_count(flows, 1234, protocol) == 0
    tcp_ports = struct.pack(">HHI", 40_000, 1234, 0)
    packet_without_option = ipv4(tcp_ports, protocol=TCP)
    # A header of 24 bytes, whose option looks like another port.
    packet_with_option = (
        bytes((0x46,)) + packet_without_option[1:20] + struct.pack(">HH", 7, 7) + packet_without_option[20:]
    )
    for packet in (
        packet_without_option,
        packet_with_option,
        ipv4(tcp_ports, protocol=TCP, src=RECEIVER, dst=SENDER),
        ipv4(tcp_ports, protocol=1),
    ):
        flows.note_first_fragment(packet)
        flows.count(packet, PACKET, packet[16:20])
    assert (packet_count(flows, 1234, TCP), packet_count(flows, 1234)) == (2, 0)


def test_a_packet_that_is_forwarded_counts_once_with_the_time_of_all_its_hops() -> None:
    flows = FlowDelays()
    assert packet_count(flows, 1234) == 0
    (packet,) = datagram(1, 100, port=1234)
    # Forwarding decrements the time to live on each hop.
    hops = [packet[:8] + bytes((64 - number,)) + packet[9:] for number in range(3)]
    for hop, receiver in zip(hops, (b"\x0a\x2a\x00\x07", b"\x0a\x2a\x00\x08", RECEIVER_ADDRESS.packed), strict=True):
        flows.note_first_fragment(hop)
        flows.count(hop, PACKET + QUEUING_NS * 1000, receiver)
    parts = flows.delay_parts(SENDER_ADDRESS, RECEIVER_ADDRESS, UDP, 1234)
    assert (parts.packets, parts.queuing_ns) == (1, 3000)
