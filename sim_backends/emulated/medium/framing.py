"""Framing of packets on robots' devices: bare IP (TUN), or Ethernet (TAP), which names the next hop.

Where robots talk directly, the address of an IP packet says who gets it. Where they forward for each other it does
not: the next hop is whom the routing table names, and on the air, as in Ethernet, it is the MAC address of the frame.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Interface
from typing import Final

NOBODY: Final = ""

Routes = Mapping[bytes, str | None]
"""Destination address -> robot, None for everyone; empty for a robot without a place."""

_ETHERNET_BYTES: Final = 14
_IPV4_TYPE: Final = b"\x08\x00"
_GROUP_BIT: Final = 0x01
# Locally administered, not of a group: IEEE 802-2014, 8.2.
_MAC_PREFIX: Final = b"\x02\x00"
_LIMITED_BROADCAST: Final = b"\xff\xff\xff\xff"


@dataclass(frozen=True)
class Framing:
    """One way to carry packets over a device.

    Attributes:
        name: `ip` or `ethernet`.
        header_bytes: What stands before the packet; the radio's own MAC header takes its place on the air.
        carries: Whether the radio carries this; raises IndexError for an empty one.
        destination: Robot to whom it goes on this hop, None for everyone, `NOBODY` for nobody there.
        routes: Routes of a robot to others, by name.
    """

    name: str
    header_bytes: int
    carries: Callable[[bytes], bool]
    destination: Callable[[bytes, Routes], str | None]
    routes: Callable[[IPv4Interface, Mapping[str, IPv4Interface]], Routes]

    def ether_type(self, packet: bytes) -> bytes:
        """Return the type of what is carried, as Ethernet and SNAP have it (RFC 1042)."""
        return packet[12:_ETHERNET_BYTES] if self.header_bytes else _IPV4_TYPE

    def ipv4(self, packet: bytes) -> bytes | None:
        """Return the IPv4 packet in it, if there is one."""
        if not self.header_bytes:
            return packet
        return packet[_ETHERNET_BYTES:] if packet[12:_ETHERNET_BYTES] == _IPV4_TYPE else None


def mac_of(address: IPv4Address) -> bytes:
    """Return the MAC address of the robot that has this address."""
    return _MAC_PREFIX + address.packed


def _is_ipv4(packet: bytes) -> bool:
    return packet[0] >> 4 == 4


def _by_ip(packet: bytes, routes: Routes) -> str | None:
    address = packet[16:20]
    found = routes.get(address, NOBODY)
    # Multicast, RFC 5771.
    return None if found == NOBODY and address[0] >> 4 == 0xE and routes else found


def _ip_routes(own: IPv4Interface, others: Mapping[str, IPv4Interface]) -> Routes:
    routes: dict[bytes, str | None] = {address.packed: name for name, address in others.items()}
    if others:
        routes[_LIMITED_BROADCAST] = routes[own.network.broadcast_address.packed] = None
    return routes


def _is_frame(frame: bytes) -> bool:
    if not frame:
        raise IndexError("nothing was read")
    return len(frame) >= _ETHERNET_BYTES


def _by_mac(frame: bytes, routes: Routes) -> str | None:
    if frame[0] & _GROUP_BIT:
        return None if routes else NOBODY
    return routes.get(frame[:6], NOBODY)


def _mac_routes(own: IPv4Interface, others: Mapping[str, IPv4Interface]) -> Routes:  # noqa: ARG001 (as `_ip_routes`)
    return {mac_of(address.ip): name for name, address in others.items()}


IP: Final = Framing("ip", 0, _is_ipv4, _by_ip, _ip_routes)
ETHERNET: Final = Framing("ethernet", _ETHERNET_BYTES, _is_frame, _by_mac, _mac_routes)
FRAMINGS: Final = {framing.name: framing for framing in (IP, ETHERNET)}
