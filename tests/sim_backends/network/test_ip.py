"""Fragments of IP packets, and their reassembly, as RFC 791 and Linux have them."""

from random import Random

from hypothesis import given
from hypothesis import strategies as st

from sim_backends.network.ip import HEADER_BYTES, MTU_BYTES, REASSEMBLY_NS, TIMED_OUT, Reassembly, fragments
from sim_backends.network.wire import IpPacket
from sim_backends.radio.losses import LOST, RADIO_OFF

SIZES = st.integers(HEADER_BYTES, 65535)


def packet(size_bytes: int, source: str = "a", number: int = 0) -> IpPacket:
    return IpPacket(source, "b", "udp", size_bytes, ("flow", number), None)


class Told(list[tuple[int, str, str]]):
    """Losses as they were told: number, host, reason."""

    def __call__(self, packet: IpPacket, host: str, reason: str) -> None:
        self.append((packet.identity[1], host, reason))


@given(SIZES, st.integers(68, 9000))
def test_fragments_carry_every_byte_once_in_units_of_eight(size_bytes: int, mtu_bytes: int) -> None:
    made = list(fragments(packet(size_bytes), 7, mtu_bytes))
    assert [one.index for one in made] == list(range(len(made)))
    assert {(one.count, one.ip_id) for one in made} == {(len(made), 7)}
    expected_bytes = 0
    for one in made:
        assert one.offset_bytes == expected_bytes
        assert one.offset_bytes % 8 == 0
        assert HEADER_BYTES <= one.size_bytes <= mtu_bytes
        expected_bytes += one.size_bytes - HEADER_BYTES
    assert expected_bytes == size_bytes - HEADER_BYTES
    # No fragment but the last could be longer, so that there are as few as can be.
    assert all(mtu_bytes - one.size_bytes < 8 for one in made[:-1])


def test_the_longest_packet_has_45_fragments_on_ethernet() -> None:
    made = list(fragments(packet(65535), 0))
    assert [one.size_bytes for one in made] == [MTU_BYTES] * 44 + [65535 - 20 - 44 * 1480 + 20]


def test_every_fragment_has_draws_of_its_own_which_are_the_same_in_every_run() -> None:
    names = [one.identity for one in fragments(packet(4000, number=5), 1)]
    assert names == [("flow", 5), ("flow fragment 1", 5), ("flow fragment 2", 5)]
    assert names == [one.identity for one in fragments(packet(4000, number=5), 99)]


@given(st.integers(1500, 20_000), st.randoms())
def test_a_packet_is_whole_with_its_last_fragment_in_any_order(size_bytes: int, order: Random) -> None:
    told = Told()
    reassembly = Reassembly(told)
    parts = list(fragments(packet(size_bytes), 3))
    order.shuffle(parts)
    whole = [reassembly.arrived(at_ns, "b", part) for at_ns, part in enumerate(parts)]
    assert whole == [False] * (len(parts) - 1) + [True]
    assert not told


def test_packets_of_one_number_from_two_sources_and_at_two_hosts_do_not_mix() -> None:
    reassembly = Reassembly(Told())
    one, other = (list(fragments(packet(2000, source), 3)) for source in "ac")
    assert not reassembly.arrived(0, "b", one[0])
    assert not reassembly.arrived(0, "b", other[1])
    assert not reassembly.arrived(0, "d", one[1])
    assert reassembly.arrived(0, "b", one[1])
    assert reassembly.arrived(0, "b", other[0])
    assert reassembly.arrived(0, "d", one[0])


def test_a_lost_fragment_loses_the_packet_once_and_what_follows_makes_no_other() -> None:
    told = Told()
    reassembly = Reassembly(told)
    first, second, third = fragments(packet(4000), 1)
    assert not reassembly.arrived(0, "b", first)
    reassembly.missing("b", second, LOST)
    reassembly.missing("b", third, LOST)
    assert told == [(0, "b", LOST)]
    # The same number again is another packet, as after 65536 others.
    assert [reassembly.arrived(1, "b", one) for one in (first, second, third)] == [False, False, True]


def test_the_rest_of_a_packet_is_waited_for_thirty_seconds_from_its_first_fragment_on() -> None:
    for late_ns, lost in ((REASSEMBLY_NS - 1, False), (REASSEMBLY_NS, True)):
        told = Told()
        reassembly = Reassembly(told)
        first, second, third = fragments(packet(4000), 1)
        reassembly.arrived(5, "b", second)
        reassembly.arrived(5 + REASSEMBLY_NS // 2, "b", first)
        assert reassembly.arrived(5 + late_ns, "b", third) is not lost
        assert told == ([(0, "b", TIMED_OUT)] if lost else [])


def test_what_a_host_has_of_packets_is_gone_when_it_is_switched_off() -> None:
    told = Told()
    reassembly = Reassembly(told)
    first, second = fragments(packet(2000), 1)
    reassembly.arrived(0, "b", first)
    reassembly.arrived(0, "c", first)
    reassembly.forget("b", RADIO_OFF)
    assert told == [(0, "b", RADIO_OFF)]
    assert not reassembly.arrived(1, "b", second)
    assert reassembly.arrived(1, "c", second)
    assert told == [(0, "b", RADIO_OFF)]
