"""Receivers of packets and frames; scapy builds the packets."""

import socket
from collections.abc import Iterator
from contextlib import ExitStack
from ipaddress import IPv4Address, IPv4Interface

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scapy.layers.inet import IP, UDP
from scapy.layers.inet6 import IPv6
from scapy.layers.l2 import ARP, Ether

from fieldkit.config.profiles import Radio
from sim_backends.emulated.medium.framing import ETHERNET, NO_ROBOT, mac_of
from sim_backends.emulated.medium.framing import IP as BARE
from sim_backends.emulated.medium.medium_client import MediumClient
from sim_backends.radio.radio_options import RadioOptions

OWN_ADDRESS = IPv4Interface("10.42.0.1/24")
OTHER_ADDRESSES = {"b": IPv4Interface("10.42.0.2/24"), "c": IPv4Interface("10.42.0.3/24")}
MACS = {"a": "02:00:0a:2a:00:01", "b": "02:00:0a:2a:00:02", "c": "02:00:0a:2a:00:03"}
ADDRESSES = {"a": OWN_ADDRESS, **OTHER_ADDRESSES}
RADIO = Radio(interface="wlan0", standard="802.11g", tx_power_dbm=17, sensitivity_dbm=-82)


def test_a_mac_address_belongs_to_one_station_and_is_locally_administered() -> None:
    assert {name: mac_of(interface.ip).hex(":") for name, interface in ADDRESSES.items()} == MACS


@pytest.mark.parametrize(
    ("destination", "expected"),
    [
        ("10.42.0.2", "b"),
        ("10.42.0.255", None),
        ("255.255.255.255", None),
        ("239.1.2.3", None),
        ("10.42.0.9", NO_ROBOT),
        ("192.168.0.1", NO_ROBOT),
    ],
)
def test_a_bare_packet_goes_to_its_destination_address(destination: str, expected: str | None) -> None:
    packet = bytes(IP(src="10.42.0.1", dst=destination) / UDP())
    assert BARE.carries(packet)
    assert BARE.destination(packet, BARE.routes(OWN_ADDRESS, OTHER_ADDRESSES)) == expected
    assert BARE.destination(packet, BARE.routes(OWN_ADDRESS, {})) == NO_ROBOT
    assert not BARE.carries(bytes(IPv6()))


@pytest.mark.parametrize(
    ("destination", "expected"),
    [
        (MACS["b"], "b"),
        ("ff:ff:ff:ff:ff:ff", None),
        ("01:00:5e:01:02:03", None),
        ("33:33:00:01:00:06", None),
        ("02:00:0a:2a:00:09", NO_ROBOT),
    ],
)
def test_a_frame_goes_to_the_next_hop_with_any_payload(destination: str, expected: str | None) -> None:
    for inner in (IP(dst="10.42.0.3"), IPv6(dst="ff02::1:6"), ARP()):
        frame = bytes(Ether(dst=destination, src=MACS["a"]) / inner)
        assert ETHERNET.carries(frame)
        assert ETHERNET.destination(frame, ETHERNET.routes(OWN_ADDRESS, OTHER_ADDRESSES)) == expected
        assert ETHERNET.destination(frame, ETHERNET.routes(OWN_ADDRESS, {})) == NO_ROBOT


def test_a_frame_contains_an_ipv4_packet_if_its_ether_type_is_ipv4() -> None:
    packet = bytes(IP(dst="10.42.0.3") / UDP())
    frame = bytes(Ether(dst=MACS["b"], src=MACS["a"]) / IP(packet))
    assert (ETHERNET.ipv4(frame), BARE.ipv4(packet)) == (packet, packet)
    assert ETHERNET.ether_type(frame) == BARE.ether_type(packet) == b"\x08\x00"
    arp = bytes(Ether(dst=MACS["b"], src=MACS["a"]) / ARP())
    assert (ETHERNET.ipv4(arp), ETHERNET.ether_type(arp)) == (None, b"\x08\x06")


@given(st.binary(min_size=1, max_size=40), st.ip_addresses(v=4))
def test_any_bytes_are_carried_or_ignored(frame: bytes, address: IPv4Address) -> None:
    routes = ETHERNET.routes(OWN_ADDRESS, {"x": IPv4Interface(address)})
    assert not ETHERNET.carries(frame) or len(frame) >= 14
    assert ETHERNET.destination(frame, routes) in {None, NO_ROBOT, "x"}


@pytest.fixture
def air() -> Iterator[tuple[MediumClient, dict[str, socket.socket]]]:
    """Return a medium of frames between a, b and c, in a row 60 m apart; a and c are out of range of each other."""
    with ExitStack() as stack:
        medium = stack.enter_context(MediumClient(RadioOptions(fading=False), seed=1, framing=ETHERNET))
        robot_ends: dict[str, socket.socket] = {}
        for name, address in ADDRESSES.items():
            robot_end, medium_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
            robot_ends[name] = stack.enter_context(robot_end)
            robot_end.settimeout(30)
            with medium_end:
                medium.attach(name, str(address), RADIO, medium_end.fileno())
        medium.place({name: (60.0 * number, 0.0, 0.2) for number, name in enumerate(ADDRESSES)})
        yield medium, robot_ends


def test_a_broadcast_reaches_only_robots_in_range(
    air: tuple[MediumClient, dict[str, socket.socket]],
) -> None:
    medium, robot_ends = air
    broadcast = bytes(Ether(dst="ff:ff:ff:ff:ff:ff", src=MACS["b"]) / IP(dst="255.255.255.255") / UDP())
    robot_ends["b"].send(broadcast)
    assert [robot_ends[name].recv(2000) for name in ("a", "c")] == [broadcast, broadcast]
    # Robot a is out of range of c, so the next frame that it receives is from b.
    robot_ends["c"].send(bytes(Ether(dst="33:33:00:01:00:06", src=MACS["c"]) / IPv6()))
    assert robot_ends["b"].recv(2000)[:6] == bytes.fromhex("333300010006")
    forwarded_frame = bytes(Ether(dst=MACS["a"], src=MACS["b"]) / IP(src="10.42.0.3", dst="10.42.0.1") / UDP())
    robot_ends["b"].send(forwarded_frame)
    assert robot_ends["a"].recv(2000) == forwarded_frame
    links = medium.stats().links
    assert (links["b", "a"].delivered, links["b", "c"].delivered, links["c", "b"].delivered) == (2, 1, 1)
    assert ("c", "a") not in links or not links["c", "a"].delivered


def test_a_frame_out_of_range_is_lost_and_an_unknown_address_is_counted(
    air: tuple[MediumClient, dict[str, socket.socket]],
) -> None:
    medium, robot_ends = air
    for destination in (MACS["c"], "02:00:00:00:00:99"):
        robot_ends["a"].send(bytes(Ether(dst=destination, src=MACS["a"]) / IP(dst="10.42.0.3")))
    robot_ends["a"].send(last_frame := bytes(Ether(dst=MACS["b"], src=MACS["a"]) / IP(dst="10.42.0.3")))
    assert robot_ends["b"].recv(2000) == last_frame
    stats = medium.stats()
    assert stats.links["a", "c"].lost == 1
    assert (stats.ports["a"].unroutable_packets, stats.ports["c"].delivered_packets) == (1, 0)
