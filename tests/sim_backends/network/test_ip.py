"""Fragmentation and reassembly of IP packets according to RFC 791 and Linux."""

from random import Random

from hypothesis import given
from hypothesis import strategies as st

from sim_backends.network.ip import HEADER_BYTES, MTU_BYTES, REASSEMBLY_NS, TIMED_OUT, Reassembly, fragments
from sim_backends.network.wire import IpPacket
from sim_backends.radio.core.links import LOST, RADIO_OFF

SIZES = st.integers(HEADER_BYTES, 65535)


def packet(size_bytes: int, source: str = "a", number: int = 0) -> IpPacket:
    return IpPacket(source, "b", "udp", size_bytes, ("flow", number), None)


class LossLog(list[tuple[int, str, str]]):
    """Reported losses: number, host, reason."""

    def __call__(self, packet: IpPacket, host: str, reason: str) -> None:
        self.append((packet.identity[1], host, reason))


@given(SIZES, st.integers(68, 9000))
def test_fragments_carry_every_byte_once_in_units_of_8_bytes(size_bytes: int, mtu_bytes: int) -> None:
    packet_fragments = list(fragments(packet(size_bytes), 7, mtu_bytes))
    assert [fragment.index for fragment in packet_fragments] == list(range(len(packet_fragments)))
    assert {(fragment.count, fragment.ip_id) for fragment in packet_fragments} == {(len(packet_fragments), 7)}
    expected_bytes = 0
    for fragment in packet_fragments:
        assert fragment.offset_bytes == expected_bytes
        assert fragment.offset_bytes % 8 == 0
        assert HEADER_BYTES <= fragment.size_bytes <= mtu_bytes
        expected_bytes += fragment.size_bytes - HEADER_BYTES
    assert expected_bytes == size_bytes - HEADER_BYTES
    # No fragment but the last could be longer, so the number of fragments is minimal.
    assert all(mtu_bytes - fragment.size_bytes < 8 for fragment in packet_fragments[:-1])


def test_the_longest_packet_has_45_fragments_on_ethernet() -> None:
    packet_fragments = list(fragments(packet(65535), 0))
    assert [fragment.size_bytes for fragment in packet_fragments] == [MTU_BYTES] * 44 + [65535 - 20 - 44 * 1480 + 20]


def test_every_fragment_has_separate_reproducible_draws() -> None:
    identities = [fragment.identity for fragment in fragments(packet(4000, number=5), 1)]
    assert identities == [("flow", 5), ("flow fragment 1", 5), ("flow fragment 2", 5)]
    assert identities == [fragment.identity for fragment in fragments(packet(4000, number=5), 99)]


@given(st.integers(1500, 20_000), st.randoms())
def test_a_packet_is_complete_with_its_last_fragment_in_any_order(size_bytes: int, order: Random) -> None:
    losses = LossLog()
    reassembly = Reassembly(losses)
    shuffled = list(fragments(packet(size_bytes), 3))
    order.shuffle(shuffled)
    completions = [reassembly.on_arrival(at_ns, "b", part) for at_ns, part in enumerate(shuffled)]
    assert completions == [False] * (len(shuffled) - 1) + [True]
    assert not losses


def test_packets_with_equal_numbers_are_distinguished_by_source_and_host() -> None:
    reassembly = Reassembly(LossLog())
    first_source, second_source = (list(fragments(packet(2000, source), 3)) for source in "ac")
    assert not reassembly.on_arrival(0, "b", first_source[0])
    assert not reassembly.on_arrival(0, "b", second_source[1])
    assert not reassembly.on_arrival(0, "d", first_source[1])
    assert reassembly.on_arrival(0, "b", first_source[1])
    assert reassembly.on_arrival(0, "b", second_source[0])
    assert reassembly.on_arrival(0, "d", first_source[0])


def test_a_lost_fragment_loses_the_packet_once_and_a_reused_number_is_a_new_packet() -> None:
    losses = LossLog()
    reassembly = Reassembly(losses)
    first, second, third = fragments(packet(4000), 1)
    assert not reassembly.on_arrival(0, "b", first)
    reassembly.on_loss("b", second, LOST)
    reassembly.on_loss("b", third, LOST)
    assert losses == [(0, "b", LOST)]
    # The same number again is a new packet, as after 65536 others.
    assert [reassembly.on_arrival(1, "b", fragment) for fragment in (first, second, third)] == [False, False, True]


def test_reassembly_times_out_30_s_after_the_first_fragment() -> None:
    for delay_ns, is_lost in ((REASSEMBLY_NS - 1, False), (REASSEMBLY_NS, True)):
        losses = LossLog()
        reassembly = Reassembly(losses)
        first, second, third = fragments(packet(4000), 1)
        reassembly.on_arrival(5, "b", second)
        reassembly.on_arrival(5 + REASSEMBLY_NS // 2, "b", first)
        assert reassembly.on_arrival(5 + delay_ns, "b", third) is not is_lost
        assert losses == ([(0, "b", TIMED_OUT)] if is_lost else [])


def test_switching_off_a_host_discards_its_incomplete_packets() -> None:
    losses = LossLog()
    reassembly = Reassembly(losses)
    first, second = fragments(packet(2000), 1)
    reassembly.on_arrival(0, "b", first)
    reassembly.on_arrival(0, "c", first)
    reassembly.discard("b", RADIO_OFF)
    assert losses == [(0, "b", RADIO_OFF)]
    assert not reassembly.on_arrival(1, "b", second)
    assert reassembly.on_arrival(1, "c", second)
    assert losses == [(0, "b", RADIO_OFF)]
