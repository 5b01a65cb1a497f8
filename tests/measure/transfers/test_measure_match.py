"""Matches of received and sent packets, compared with given copies."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scapy.layers.inet import TCP
from scapy.layers.inet6 import IPv6, IPv6ExtHdrFragment
from scapy.packet import Raw

from fieldkit.core.errors import EvidenceError
from fieldkit.measure.captures.arrays import Ints
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.transfers.match import NONE, assign, match, match_keys, match_payload
from tests.helpers.captures import Frame, datagram, ipv4, packets, segment, timed
from tests.helpers.nightly import examples

time_sets = st.sets(st.integers(0, 30), min_size=1, max_size=12).map(
    lambda moments_ms: [4 * moment for moment in sorted(moments_ms)]
)


@given(st.integers(1, 30), st.data())
def test_packets_with_unique_ids_are_matched_individually(count: int, data: st.DataObject) -> None:
    """Packets are lost, copied and reordered, have any clock offset, and some are not in the sender's capture."""
    sent_frames = timed([datagram(ip_id, 100)[0] for ip_id in range(count)])
    arrivals = data.draw(st.lists(st.integers(0, count + 3), max_size=2 * count))
    clock_ns = data.draw(st.integers(0, 10**18))
    received_frames = [
        Frame(clock_ns + position, datagram(index, 100)[0], wire_bytes=128) for position, index in enumerate(arrivals)
    ]

    result = match(packets(sent_frames), packets(received_frames))

    assert result.received_index.tolist() == [
        arrivals.index(index) if index in arrivals else NONE for index in range(count)
    ]
    assert result.sent_index.tolist() == [index if index < count else NONE for index in arrivals]
    assert result.duplicates.tolist() == [
        index < count and index in arrivals[:position] for position, index in enumerate(arrivals)
    ]
    assert not result.ambiguous.any()


@given(st.integers(2, 5), st.integers(2, 5), st.data())
def test_packets_with_repeated_ids_are_matched_within_their_round(ids: int, rounds: int, data: st.DataObject) -> None:
    """Rounds are 5 s apart, delays at most 1 s, and the clock offset at most a day. One id is unique."""
    clock_ns = data.draw(st.integers(-(10**14), 10**14))
    sent_frames, received_frames, sent_indices = (
        [Frame(10**15, datagram(999, 9)[0])],
        [Frame(10**15 + clock_ns, datagram(999, 9)[0])],
        [0],
    )
    for number in range(ids * rounds):
        at_ns = 10**15 + (1 + number // ids) * 5 * 10**9 + number
        sent_frames.append(Frame(at_ns, datagram(number % ids, 9)[0]))
        if data.draw(st.booleans()):
            received_frames.append(Frame(at_ns + clock_ns + data.draw(st.integers(0, 10**9)), sent_frames[-1].data))
            sent_indices.append(len(sent_frames) - 1)
    order = data.draw(st.permutations(range(len(received_frames))))

    result = match(packets(sent_frames), packets([received_frames[position] for position in order]))

    assert result.sent_index.tolist() == [sent_indices[position] for position in order]
    assert not result.duplicates.any()


@given(time_sets, time_sets)
@settings(max_examples=examples(500))
def test_items_are_assigned_to_the_nearest_in_time(sent_times: list[int], received_times: list[int]) -> None:
    """The oracle is a loop over one group. The second group was received completely and gives the offset of 1."""
    positions, is_clear, _ = assign(
        np.array([0] * len(sent_times) + [1, 1, 1]),
        np.array([*sent_times, 5, 7, 9]),
        np.array([0] * len(received_times) + [1, 1, 1]),
        np.array([1 + 1 + moment for moment in received_times] + [6, 8, 10]),
    )
    n_missing = len(sent_times) - len(received_times)
    expected: list[int] = []
    for rank, moment in enumerate(received_times):
        nearest = min(range(len(sent_times)), key=lambda position: abs(sent_times[position] - (moment + 1)))
        before = expected[-1] if expected else -1
        if n_missing > 0:
            expected.append(min(max(nearest, before + 1), rank + n_missing))
        else:
            expected.append(min(max(nearest, rank + n_missing), before + 1))
    if n_missing == 0:
        expected = list(range(len(sent_times)))
    assert positions.tolist() == [*expected, 0, 1, 2]
    assert is_clear.tolist() == [len(sent_times) == 1, False]


def test_equal_packets_are_matched_in_order_and_ambiguous() -> None:
    sent_frames = packets([Frame(10**15 + time_ms * 10**6, datagram(0, 100)[0]) for time_ms in (0, 1, 2, 5, 6, 9)])
    received_frames = packets([Frame(10**17 + time_ms * 10**6, datagram(0, 100)[0]) for time_ms in (0, 2, 6, 9)])
    result = match(sent_frames, received_frames)
    assert result.sent_index.tolist() == [0, 2, 4, 5]
    assert result.ambiguous.all()
    assert match(sent_frames, sent_frames).ambiguous.all(), "the same number of losses and copies is possible"
    assert not result.possible_copy.any()


def test_the_clock_offset_is_taken_from_groups_that_arrived_completely() -> None:
    """Ids repeat, and the first round was not captured at the receiver: the offset is that of the second round."""
    key, received_key = np.array([1, 2, 1, 2, 3], dtype=np.uint64), np.array([1, 2, 3], dtype=np.uint64)
    result = match_keys(key, np.array([0, 1, 50, 51, 60]), received_key, np.array([150, 151, 160]))
    assert result.received_index.tolist() == [NONE, NONE, 0, 1, 2]


def _v6(ip_id: int, offset: int) -> bytes:
    return bytes(
        IPv6(src="fd00::1", dst="fd00::2") / IPv6ExtHdrFragment(id=ip_id, offset=offset, m=1, nh=17) / Raw(bytes(64))
    )


def test_ids_of_ipv6_fragments_have_32_bits() -> None:
    ids = [7, 7 + 2**16, 7 + 2**18, 7 + 2**31]
    sent_frames = packets(timed([_v6(ip_id, 8) for ip_id in ids]))
    for index, ip_id in enumerate(ids):
        result = match(sent_frames, packets(timed([_v6(ip_id, 8)])))
        assert result.arrived.tolist() == [position == index for position in range(len(ids))]
        assert not result.ambiguous.any()


def test_other_lengths_ports_addresses_and_protocols_are_other_packets() -> None:
    packet = datagram(5, 100)[0]
    different_packets = [
        datagram(5, 101)[0],
        datagram(5, 100, port=9)[0],
        datagram(5, 100, sport=9)[0],
        ipv4(packet[20:], protocol=17, size=108, ip_id=5, src="10.9.0.3"),
        ipv4(packet[20:], protocol=17, size=108, ip_id=5, dst="10.9.0.3"),
        ipv4(packet[20:], protocol=6, size=108, ip_id=5),
        datagram(6, 100)[0],
    ]
    result = match(packets(timed([packet])), packets(timed(different_packets)))
    assert not result.arrived.any()
    assert result.sent_index.tolist() == [NONE] * len(different_packets)


def test_frames_split_by_offload_match_the_frame_with_their_first_byte() -> None:
    sent_frames = packets(timed([segment(0, 0, flags=2), segment(1, 3000, ip_id=1), segment(3001, 1000, ip_id=4)]))
    split_frames = [
        segment(0, 0, flags=2),
        segment(1, 1000, ip_id=1),
        segment(1001, 1000, ip_id=2),
        segment(2001, 2000, ip_id=3),
    ]
    result = match(sent_frames, packets(timed([*split_frames, split_frames[2]])))
    assert result.received_index.tolist() == [0, 1, 3]
    assert result.sent_index.tolist() == [0, 1, 1, 1, 1]
    assert result.duplicates.tolist() == [False, False, False, False, True]


def test_acknowledgments_without_payload_are_matched_by_their_numbers() -> None:
    def acks(*numbers: int) -> Packets:
        return packets(
            timed([bytes(IPv6(src="::1", dst="::2") / TCP(seq=5, ack=number, flags="A")) for number in numbers])
        )

    result = match(acks(10, 20, 30), acks(10, 30))
    assert result.received_index.tolist() == [0, NONE, 1]


frames = st.lists(st.tuples(st.integers(0, 40), st.integers(0, 15), st.integers(0, 3)), max_size=15)


@given(st.integers(0, 2**32 - 1), frames, frames, st.sampled_from((0, 100)))
@settings(max_examples=examples(300))
def test_each_byte_has_as_many_matches_as_copies_sent_and_received(
    isn: int, sent_ranges: list[tuple[int, int, int]], received_ranges: list[tuple[int, int, int]], other_ids: int
) -> None:
    """The oracle is a list of single bytes for each end. If equal frames exist, fewer bytes may match."""
    ends = [
        packets(
            timed(
                [segment(isn + start, size, ip_id=ip_id + id_offset) for start, size, ip_id in ((0, 0, 0), *ranges)]
            )
        )
        for ranges, id_offset in ((sent_ranges, 0), (received_ranges, other_ids))
    ]
    result = match_payload(*ends)
    sent_pieces, received_pieces, has_arrived = result.sent, result.received, result.match.arrived
    bytes_sent, bytes_received = _single_bytes(sent_ranges), _single_bytes(received_ranges)
    assert (sent_pieces.size_bytes.sum(), received_pieces.size_bytes.sum()) == (len(bytes_sent), len(bytes_received))
    assert (
        sent_pieces.range_id[has_arrived].tolist()
        == received_pieces.range_id[result.match.received_index[has_arrived]].tolist()
    )
    expected = sum(min(bytes_sent.count(byte), bytes_received.count(byte)) for byte in set(bytes_sent))
    assert (
        (sent_pieces.size_bytes[has_arrived].sum() == expected)
        if other_ids
        else (sent_pieces.size_bytes[has_arrived].sum() <= expected)
    )
    first_copies = (result.match.sent_index != NONE) & ~result.match.duplicates
    assert received_pieces.size_bytes[first_copies].sum() == sent_pieces.size_bytes[has_arrived].sum()


def _single_bytes(frames: list[tuple[int, int, int]]) -> list[int]:
    return [byte for start, size, _ in frames for byte in range(start, start + size)]


def test_empty_captures_have_no_matches() -> None:
    sent_index: Ints = match(packets([]), packets(timed([datagram(1, 1)[0]]))).sent_index
    assert sent_index.tolist() == [NONE]
    assert match(packets(timed([segment(1, 1)])), packets([])).received_index.tolist() == [NONE]


def test_many_overlapping_forged_frames_are_refused() -> None:
    """3,000 superframes that start one byte after each other have 9 million pieces."""
    forged_packets = packets(timed([segment(1 + index, 60_000, ip_id=index) for index in range(3000)]))
    with pytest.raises(EvidenceError, match="3000 TCP frames overlap"):
        match_payload(forged_packets, packets([]))
    few_frames = match_payload(forged_packets.where(slice(0, 500)), packets([]))
    assert few_frames.sent.size_bytes.sum() == 500 * 60_000
