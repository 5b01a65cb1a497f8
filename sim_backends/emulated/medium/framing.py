"""Framing of packets on robots' devices: bare IP (TUN), or Ethernet (TAP), whose header has the MAC of the next hop.

If robots communicate directly, the destination address of an IP packet identifies the receiver. If they forward for
each other, the receiver is the next hop of the routing table, which the MAC address of the frame identifies.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from ipaddress import IPv4Address, IPv4Interface
from typing import Final

NO_ROBOT: Final = ""
"""Value of the receiver of a packet if no robot has the destination address."""

Routes = Mapping[bytes, str | None]
"""Robot per destination address (IPv4, or MAC with Ethernet framing), None for IPv4 broadcast; empty for a robot that
can reach no other robot."""

_ETHERNET_BYTES: Final = 14
_IPV4_TYPE: Final = b"\x08\x00"
_GROUP_BIT: Final = 0x01
"""Bit of the first byte of a MAC address that marks broadcast and multicast."""
# Locally administered, not a group address: IEEE 802-2014, clause 8.
_MAC_PREFIX: Final = b"\x02\x00"
_LIMITED_BROADCAST: Final = b"\xff\xff\xff\xff"


@dataclass(frozen=True)
class Framing:
    """One encoding of packets on a device.

    Attributes:
        name: `ip` or `ethernet`.
        header_bytes: Length of the header before the packet; on the air the radio's MAC header replaces it.
        carries: Returns True if the radio carries this packet; raises IndexError if it is empty.
        destination: Returns the receiver of this hop; None for broadcast and multicast; `NO_ROBOT` if no robot has
            the address, or if there are no routes.
        routes: Returns the routes of a robot; its arguments are the robot's address, and the addresses of the robots
            that it can reach, by name.
    """

    name: str
    header_bytes: int
    carries: Callable[[bytes], bool]
    destination: Callable[[bytes, Routes], str | None]
    routes: Callable[[IPv4Interface, Mapping[str, IPv4Interface]], Routes]

    def ether_type(self, packet: bytes) -> bytes:
        """Return the EtherType of the payload, as in Ethernet and SNAP headers (RFC 1042)."""
        return packet[12:_ETHERNET_BYTES] if self.header_bytes else _IPV4_TYPE

    def ipv4(self, packet: bytes) -> bytes | None:
        """Return the IPv4 packet in a frame, or None if the frame carries another protocol."""
        if not self.header_bytes:
            return packet
        return packet[_ETHERNET_BYTES:] if packet[12:_ETHERNET_BYTES] == _IPV4_TYPE else None


def mac_of(address: IPv4Address) -> bytes:
    """Return the MAC address of the robot that has this IPv4 address."""
    return _MAC_PREFIX + address.packed


def _is_ipv4(packet: bytes) -> bool:
    return packet[0] >> 4 == 4


def _receiver_by_ip(packet: bytes, routes: Routes) -> str | None:
    address = packet[16:20]
    robot = routes.get(address, NO_ROBOT)
    # Multicast: 224.0.0.0/4, RFC 5771. A robot without routes reaches no other robot.
    return None if robot == NO_ROBOT and address[0] >> 4 == 0xE and routes else robot


def _ip_routes(own_address: IPv4Interface, others: Mapping[str, IPv4Interface]) -> Routes:
    routes: dict[bytes, str | None] = {address.packed: name for name, address in others.items()}
    if others:
        routes[_LIMITED_BROADCAST] = routes[own_address.network.broadcast_address.packed] = None
    return routes


def _is_frame(frame: bytes) -> bool:
    if not frame:
        raise IndexError("nothing was read")
    return len(frame) >= _ETHERNET_BYTES


def _receiver_by_mac(frame: bytes, routes: Routes) -> str | None:
    if frame[0] & _GROUP_BIT:
        return None if routes else NO_ROBOT
    return routes.get(frame[:6], NO_ROBOT)


def _mac_routes(own_address: IPv4Interface, others: Mapping[str, IPv4Interface]) -> Routes:  # noqa: ARG001 (same signature as `_ip_routes`)
    return {mac_of(address.ip): name for name, address in others.items()}


IP: Final = Framing("ip", 0, _is_ipv4, _receiver_by_ip, _ip_routes)
ETHERNET: Final = Framing("ethernet", _ETHERNET_BYTES, _is_frame, _receiver_by_mac, _mac_routes)
FRAMINGS: Final = {framing.name: framing for framing in (IP, ETHERNET)}
