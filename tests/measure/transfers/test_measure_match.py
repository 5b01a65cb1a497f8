"""Which packet received is the copy of which sent, against what the test itself sent."""

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

moments = st.sets(st.integers(0, 30), min_size=1, max_size=12).map(lambda these: [4 * one for one in sorted(these)])


@given(st.integers(1, 30), st.data())
def test_packets_with_ids_of_their_own_are_matched_one_by_one(count: int, data: st.DataObject) -> None:
    """Lost, copied, in any order, by any clock, among packets that nobody sent."""
    sent = timed([datagram(ip_id, 100)[0] for ip_id in range(count)])
    arrivals = data.draw(st.lists(st.integers(0, count + 3), max_size=2 * count))
    clock_ns = data.draw(st.integers(0, 10**18))
    received = [
        Frame(clock_ns + place, datagram(index, 100)[0], wire_bytes=128) for place, index in enumerate(arrivals)
    ]

    found = match(packets(sent), packets(received))

    assert found.received_index.tolist() == [
        arrivals.index(index) if index in arrivals else NONE for index in range(count)
    ]
    assert found.sent_index.tolist() == [index if index < count else NONE for index in arrivals]
    assert found.duplicates.tolist() == [
        index < count and index in arrivals[:place] for place, index in enumerate(arrivals)
    ]
    assert not found.doubtful.any()


@given(st.integers(2, 5), st.integers(2, 5), st.data())
def test_a_wrap_of_the_ids_matches_no_packet_with_one_of_another_round(
    ids: int, rounds: int, data: st.DataObject
) -> None:
    """Rounds 5 s apart, delays of up to 1 s, a clock that is off by up to a day; one id is of its own."""
    clock_ns = data.draw(st.integers(-(10**14), 10**14))
    sent, received, origin = (
        [Frame(10**15, datagram(999, 9)[0])],
        [Frame(10**15 + clock_ns, datagram(999, 9)[0])],
        [0],
    )
    for number in range(ids * rounds):
        at_ns = 10**15 + (1 + number // ids) * 5 * 10**9 + number
        sent.append(Frame(at_ns, datagram(number % ids, 9)[0]))
        if data.draw(st.booleans()):
            received.append(Frame(at_ns + clock_ns + data.draw(st.integers(0, 10**9)), sent[-1].data))
            origin.append(len(sent) - 1)
    order = data.draw(st.permutations(range(len(received))))

    found = match(packets(sent), packets([received[place] for place in order]))

    assert found.sent_index.tolist() == [origin[place] for place in order]
    assert not found.duplicates.any()


@given(moments, moments)
@settings(max_examples=500)
def test_the_nearest_in_time_is_taken_as_far_as_each_finds_one(sent: list[int], received: list[int]) -> None:
    """Against a loop over one group; a second group, of as many sent as received, tells the clock: 1 ahead."""
    found, told, _ = assign(
        np.array([0] * len(sent) + [1, 1, 1]),
        np.array([*sent, 5, 7, 9]),
        np.array([0] * len(received) + [1, 1, 1]),
        np.array([1 + 1 + one for one in received] + [6, 8, 10]),
    )
    skipped = len(sent) - len(received)
    expected: list[int] = []
    for rank, moment in enumerate(received):
        near = min(range(len(sent)), key=lambda place: abs(sent[place] - (moment + 1)))
        before = expected[-1] if expected else -1
        if skipped > 0:
            expected.append(min(max(near, before + 1), rank + skipped))
        else:
            expected.append(min(max(near, rank + skipped), before + 1))
    if skipped == 0:
        expected = list(range(len(sent)))
    assert found.tolist() == [*expected, 0, 1, 2]
    assert told.tolist() == [len(sent) == 1, False]


def test_packets_that_all_look_alike_are_matched_in_order_and_doubted() -> None:
    sent = packets([Frame(10**15 + at * 10**6, datagram(0, 100)[0]) for at in (0, 1, 2, 5, 6, 9)])
    received = packets([Frame(10**17 + at * 10**6, datagram(0, 100)[0]) for at in (0, 2, 6, 9)])
    found = match(sent, received)
    assert found.sent_index.tolist() == [0, 2, 4, 5]
    assert found.doubtful.all()
    assert match(sent, sent).doubtful.all(), "as many losses as copies look the same"
    assert not found.possible_copy.any()


def test_the_clocks_are_compared_by_what_came_whole() -> None:
    """Ids come again, the first round was not captured at the receiver: nearest to the clock is the second."""
    key, came = np.array([1, 2, 1, 2, 3], dtype=np.uint64), np.array([1, 2, 3], dtype=np.uint64)
    found = match_keys(key, np.array([0, 1, 50, 51, 60]), came, np.array([150, 151, 160]))
    assert found.received_index.tolist() == [NONE, NONE, 0, 1, 2]


def _v6(ip_id: int, offset: int) -> bytes:
    return bytes(
        IPv6(src="fd00::1", dst="fd00::2") / IPv6ExtHdrFragment(id=ip_id, offset=offset, m=1, nh=17) / Raw(bytes(64))
    )


def test_ids_of_ipv6_fragments_have_32_bits() -> None:
    ids = [7, 7 + 2**16, 7 + 2**18, 7 + 2**31]
    sent = packets(timed([_v6(ip_id, 8) for ip_id in ids]))
    for index, ip_id in enumerate(ids):
        found = match(sent, packets(timed([_v6(ip_id, 8)])))
        assert found.arrived.tolist() == [place == index for place in range(len(ids))]
        assert not found.doubtful.any()


def test_other_lengths_ports_addresses_and_protocols_are_other_packets() -> None:
    one = datagram(5, 100)[0]
    others = [
        datagram(5, 101)[0],
        datagram(5, 100, port=9)[0],
        datagram(5, 100, sport=9)[0],
        ipv4(one[20:], protocol=17, size=108, ip_id=5, src="10.9.0.3"),
        ipv4(one[20:], protocol=17, size=108, ip_id=5, dst="10.9.0.3"),
        ipv4(one[20:], protocol=6, size=108, ip_id=5),
        datagram(6, 100)[0],
    ]
    found = match(packets(timed([one])), packets(timed(others)))
    assert not found.arrived.any()
    assert found.sent_index.tolist() == [NONE] * len(others)


def test_frames_of_offload_belong_to_the_frame_with_their_first_byte() -> None:
    sent = packets(timed([segment(0, 0, flags=2), segment(1, 3000, ip_id=1), segment(3001, 1000, ip_id=4)]))
    cut = [
        segment(0, 0, flags=2),
        segment(1, 1000, ip_id=1),
        segment(1001, 1000, ip_id=2),
        segment(2001, 2000, ip_id=3),
    ]
    found = match(sent, packets(timed([*cut, cut[2]])))
    assert found.received_index.tolist() == [0, 1, 3]
    assert found.sent_index.tolist() == [0, 1, 1, 1, 1]
    assert found.duplicates.tolist() == [False, False, False, False, True]


def test_acknowledgments_without_payload_are_matched_by_their_numbers() -> None:
    def acks(*numbers: int) -> Packets:
        return packets(timed([bytes(IPv6(src="::1", dst="::2") / TCP(seq=5, ack=one, flags="A")) for one in numbers]))

    found = match(acks(10, 20, 30), acks(10, 30))
    assert found.received_index.tolist() == [0, NONE, 1]


frames = st.lists(st.tuples(st.integers(0, 40), st.integers(0, 15), st.integers(0, 3)), max_size=15)


@given(st.integers(0, 2**32 - 1), frames, frames, st.sampled_from((0, 100)))
@settings(max_examples=300)
def test_of_each_byte_as_many_copies_arrive_as_were_sent_and_received(
    isn: int, sent: list[tuple[int, int, int]], received: list[tuple[int, int, int]], other_ids: int
) -> None:
    """Any frames at either end against lists of single bytes; fewer arrive where equal frames say: a copy of that."""
    ends = [
        packets(timed([segment(isn + start, size, ip_id=ip_id + more) for start, size, ip_id in ((0, 0, 0), *these)]))
        for these, more in ((sent, 0), (received, other_ids))
    ]
    found = match_payload(*ends)
    left, came, arrived = found.sent, found.received, found.match.arrived
    bytes_sent, bytes_received = _singly(sent), _singly(received)
    assert (left.size_bytes.sum(), came.size_bytes.sum()) == (len(bytes_sent), len(bytes_received))
    assert left.range_id[arrived].tolist() == came.range_id[found.match.received_index[arrived]].tolist()
    expected = sum(min(bytes_sent.count(byte), bytes_received.count(byte)) for byte in set(bytes_sent))
    assert (left.size_bytes[arrived].sum() == expected) if other_ids else (left.size_bytes[arrived].sum() <= expected)
    first_copies = (found.match.sent_index != NONE) & ~found.match.duplicates
    assert came.size_bytes[first_copies].sum() == left.size_bytes[arrived].sum()


def _singly(frames: list[tuple[int, int, int]]) -> list[int]:
    return [byte for start, size, _ in frames for byte in range(start, start + size)]


def test_a_match_of_nothing() -> None:
    some: Ints = match(packets([]), packets(timed([datagram(1, 1)[0]]))).sent_index
    assert some.tolist() == [NONE]
    assert match(packets(timed([segment(1, 1)])), packets([])).received_index.tolist() == [NONE]


def test_forged_frames_that_all_overlap_do_not_fill_the_memory() -> None:
    """3,000 super-frames, each a byte after the one before: 9 million pieces."""
    forged = packets(timed([segment(1 + index, 60_000, ip_id=index) for index in range(3000)]))
    with pytest.raises(EvidenceError, match="3000 TCP frames overlap"):
        match_payload(forged, packets([]))
    few = match_payload(forged.where(slice(0, 500)), packets([]))
    assert few.sent.size_bytes.sum() == 500 * 60_000
