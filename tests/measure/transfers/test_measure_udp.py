"""Randomly lost fragments compared with closed forms, and repeated ids."""

from itertools import groupby

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scapy.layers.inet import IP, UDP, fragment
from scapy.packet import Raw

from fieldkit.core.model import Protocol
from fieldkit.measure.transfers import udp
from tests.helpers.captures import PORT, RECEIVER, SENDER, Frame, datagram, ipv4, packets, timed, transfer
from tests.helpers.nightly import examples

UDP_TRANSFER = transfer(Protocol.UDP)

sizes = st.lists(st.integers(0, 9000), min_size=1, max_size=12)


def _count(sent_frames: list[Frame], received_frames: list[Frame]) -> udp.UdpCounts:
    return udp.count(udp.match_transfer(packets(sent_frames), packets(received_frames), UDP_TRANSFER))


@given(sizes, st.integers(0, 65535), st.data())
def test_counts_of_any_subset_of_fragments_equal_the_closed_form(
    sizes: list[int], start: int, data: st.DataObject
) -> None:
    fragments_by_datagram = [datagram((start + index) % 65536, size) for index, size in enumerate(sizes)]
    sent_frames = timed([packet for fragments in fragments_by_datagram for packet in fragments])
    arrives = data.draw(st.lists(st.booleans(), min_size=len(sent_frames), max_size=len(sent_frames)))
    received_frames = [frame for frame, is_received in zip(sent_frames, arrives, strict=True) if is_received]
    order = data.draw(st.permutations(received_frames))

    counts = _count(sent_frames, list(order))

    flags = iter(arrives)
    fates = [[next(flags) for _ in fragments] for fragments in fragments_by_datagram]
    payload_sizes = [[payload_bytes_of(packet) for packet in fragments] for fragments in fragments_by_datagram]
    assert counts.packets_sent == len(sent_frames)
    assert counts.packets_received == sum(arrives)
    assert counts.datagrams_sent == len(sizes)
    assert counts.datagrams_received == sum(all(fate) for fate in fates)
    assert counts.bytes_sent == sum(sizes)
    assert counts.bytes_received == sum(
        size
        for fate, parts in zip(fates, payload_sizes, strict=True)
        for is_received, size in zip(fate, parts, strict=True)
        if is_received
    )
    if received_frames:
        times = [frame.time_ns for frame in received_frames]
        assert counts.transfer_s == pytest.approx((max(times) - min(times)) / 1e9)
    else:
        assert counts.transfer_s is None


@given(st.lists(st.integers(0, 4000), min_size=1, max_size=8), st.data())
def test_bursts_copies_and_reordering_equal_a_slow_count(sizes: list[int], data: st.DataObject) -> None:
    other_datagram = datagram(1000, 3000, port=5353)
    sent_frames = timed(
        [*(packet for ip_id, size in enumerate(sizes) for packet in datagram(ip_id, size)), *other_datagram]
    )
    n_transfer_packets = len(sent_frames) - len(other_datagram)
    arrivals = data.draw(st.lists(st.integers(0, len(sent_frames) - 1), max_size=2 * len(sent_frames)))
    received_frames = [
        Frame(sent_frames[0].time_ns + position, sent_frames[index].data, 2000)
        for position, index in enumerate(arrivals)
    ]

    counts = _count(sent_frames, received_frames)

    arrived_indices = [index for index in dict.fromkeys(arrivals) if index < n_transfer_packets]
    n_reordered = sum(
        any(before > index for before in arrived_indices[:position]) for position, index in enumerate(arrived_indices)
    )
    runs = [
        len(list(run))
        for is_lost, run in groupby(range(n_transfer_packets), lambda index: index not in arrived_indices)
        if is_lost
    ]
    assert counts.packets_received == len(arrived_indices)
    assert counts.packets_duplicated == sum(index < n_transfer_packets for index in arrivals) - len(arrived_indices)
    assert counts.packets_reordered == n_reordered
    assert (counts.loss_bursts, counts.longest_burst) == (len(runs), max(runs, default=0))
    assert counts.packets_ambiguous == 0


def payload_bytes_of(packet: bytes) -> int:
    """Return the payload bytes of a fragment without the UDP header."""
    is_first = int.from_bytes(packet[6:8], "big") & 0x1FFF == 0
    return int.from_bytes(packet[2:4], "big") - 20 - (8 if is_first else 0)


@given(st.integers(1, 6), st.integers(1, 6), st.data())
@settings(max_examples=examples(200))
def test_packets_with_repeated_ids_are_distinguished_by_time(ids: int, rounds: int, data: st.DataObject) -> None:
    """The id counter wraps, so `rounds` datagrams have the same id. The clocks differ, and there is jitter."""
    clock_ns = data.draw(st.integers(-(10**12), 10**12))
    sent_frames: list[Frame] = []
    received_frames: list[Frame] = []
    n_complete = n_arrived = 0
    for round_number in range(rounds):
        for ip_id in range(ids):
            at_ns = 10**15 + round_number * 5 * 10**9 + ip_id * 10**6
            fate = data.draw(st.lists(st.booleans(), min_size=3, max_size=3))
            fragments = [Frame(at_ns + n, packet, wire_bytes=2000) for n, packet in enumerate(datagram(ip_id, 4000))]
            sent_frames += fragments
            received_frames += [
                Frame(frame.time_ns + clock_ns + data.draw(st.integers(0, 10**8)), frame.data, wire_bytes=2000)
                for frame, is_received in zip(fragments, fate, strict=True)
                if is_received
            ]
            n_complete += all(fate)
            n_arrived += sum(fate)
    # One datagram with a unique id arrives completely, which gives the clock offset.
    earlier_frames = [Frame(10**15 - 10**7, packet, wire_bytes=2000) for packet in datagram(9999, 4000)]
    sent_frames += earlier_frames
    received_frames += [Frame(frame.time_ns + clock_ns, frame.data, wire_bytes=2000) for frame in earlier_frames]

    counts = _count(sent_frames, received_frames)

    assert counts.packets_received == n_arrived + 3
    assert counts.datagrams_received == n_complete + 1


@given(st.integers(1, 40), st.data())
def test_unfragmented_packets_with_the_same_id_are_counted_as_a_multiset(n_sent: int, data: st.DataObject) -> None:
    n_received = data.draw(st.integers(0, n_sent))
    frames = timed([datagram(0, 100)[0]] * n_sent, step_ns=1000)
    arrived_frames = data.draw(st.permutations(frames))[:n_received]
    delays_ns = data.draw(st.lists(st.integers(0, 10**5), min_size=n_received, max_size=n_received))
    arrivals = [
        Frame(frame.time_ns + delay, frame.data, 2000) for frame, delay in zip(arrived_frames, delays_ns, strict=True)
    ]
    counts = _count(frames, arrivals)
    assert counts.packets_received == counts.datagrams_received == n_received
    assert counts.bytes_received == 100 * n_received
    assert counts.packets_ambiguous == (n_sent if n_sent > 1 and n_received else 0)


def test_duplicates_count_once() -> None:
    sent_frames = timed(datagram(5, 8192))
    counts = _count(sent_frames, [*sent_frames, *sent_frames[:3]])
    assert (counts.packets_sent, counts.packets_received, counts.datagrams_received) == (6, 6, 1)
    assert counts.bytes_received == 8192


def test_a_lost_first_fragment_counts_as_a_lost_datagram_but_only_its_bytes_are_lost() -> None:
    sent_frames = timed(datagram(5, 8192))
    counts = _count(sent_frames, sent_frames[1:])
    assert (counts.packets_received, counts.datagrams_received, counts.bytes_received) == (5, 0, 8192 - 1472)


def test_other_ports_hosts_and_protocols_are_ignored_even_with_equal_ids() -> None:
    transfer_fragments = datagram(5, 4000)
    other_port = datagram(5, 4000, port=5353)
    reverse = [ipv4(bytes(8), protocol=17, src=RECEIVER, dst=SENDER)]
    ping = [ipv4(bytes(8), protocol=1, size=1480, ip_id=5, more=True)]
    sent_frames = timed([*other_port, *transfer_fragments, *reverse, *ping])
    counts = _count(sent_frames, sent_frames)
    assert (counts.packets_sent, counts.packets_received) == (3, 3)
    assert (counts.datagrams_sent, counts.datagrams_received) == (1, 1)


def test_the_first_fragment_of_another_port_is_ignored() -> None:
    transfer_fragments, other_fragments = datagram(5, 100), datagram(5, 100, port=5353)
    sent_frames = timed([*other_fragments, *transfer_fragments])
    counts = _count(sent_frames, [Frame(sent_frames[1].time_ns, other_fragments[0], 2000)])
    assert (counts.packets_sent, counts.packets_received, counts.transfer_s) == (1, 0, None)


def test_a_later_fragment_captured_before_the_first_is_assigned_to_it() -> None:
    first, second, third = datagram(5, 4000)
    sent_frames = timed([second, first, third])
    counts = _count(sent_frames, sent_frames)
    assert (counts.packets_sent, counts.datagrams_received) == (3, 1)


def test_a_datagram_that_was_not_sent_completely_is_not_received_completely() -> None:
    sent_frames = timed(datagram(5, 4000)[:2])
    counts = _count(sent_frames, sent_frames)
    assert (counts.packets_received, counts.datagrams_sent, counts.datagrams_received) == (2, 1, 0)


def test_empty_captures_give_zero_counts() -> None:
    fragments_without_first = timed(datagram(5, 4000)[1:])
    assert (
        _count([], [])
        == _count(fragments_without_first, fragments_without_first)
        == udp.UdpCounts(0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, None)
    )


def test_datagrams_of_the_papers_file_fragmented_by_scapy_are_counted() -> None:
    blocks = [8192] * 35 + [293_797 - 35 * 8192]
    sent_frames: list[Frame] = []
    for number, size in enumerate(blocks):
        datagram = (
            IP(src=SENDER, dst=RECEIVER, id=65_520 + number & 0xFFFF) / UDP(sport=1, dport=PORT) / Raw(bytes(size))
        )
        fragments = fragment(datagram, 1480)  # type: ignore[no-untyped-call]
        sent_frames += [Frame(number * 10**6 + offset, bytes(packet)) for offset, packet in enumerate(fragments)]
    lost_flags = np.random.default_rng(1).random(len(sent_frames)) < 0.1
    counts = _count(
        sent_frames, [frame for frame, is_lost in zip(sent_frames, lost_flags, strict=True) if not is_lost]
    )
    assert (counts.packets_sent, counts.datagrams_sent, counts.bytes_sent) == (215, 36, 293_797)
    assert counts.packets_received == 215 - lost_flags.sum()
