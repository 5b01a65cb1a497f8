"""The internet layer: IPv4 packets in fragments no longer than the MTU, put together again where all arrive.

RFC 791, without options. A fragment that is lost takes its packet with it: nothing sends it again down here.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

from fieldkit.core.errors import ConfigurationError
from sim_backends.network.wire import IpPacket
from sim_backends.radio.random_streams import PacketIdentity

HEADER_BYTES: Final = 20
"""RFC 791, 3.1, without options."""

LONGEST_BYTES: Final = 65535
"""What the 16 bits of its length can say, RFC 791, 3.1."""

MTU_BYTES: Final = 1500
"""Linux's for Wi-Fi as for Ethernet."""

REASSEMBLY_NS: Final = 30 * 10**9
"""How long Linux waits for the rest of a packet after the first fragment of it: net.ipv4.ipfrag_time."""

TIMED_OUT: Final = "reassembly timed out"


@dataclass(frozen=True, slots=True)
class Fragment:
    """A fragment of an IP packet, or a whole one.

    Attributes:
        packet: The packet.
        ip_id: Which it is of its source's, the identification of its header but for the 16 bits of that.
        index: Which it is of the packet's fragments, from 0.
        count: How many there are.
        offset_bytes: Where what it carries begins in what the packet carries.
        size_bytes: Its size, header included.
    """

    packet: IpPacket
    ip_id: int
    index: int
    count: int
    offset_bytes: int
    size_bytes: int

    @property
    def identity(self) -> PacketIdentity:
        """What its draws are keyed by: the first fragment's are those of a packet that needs no other."""
        flow, number = self.packet.identity
        return (f"{flow} fragment {self.index}", number) if self.index else (flow, number)


def fragments(packet: IpPacket, ip_id: int, mtu_bytes: int = MTU_BYTES) -> Iterator[Fragment]:
    """Yield the fragments of a packet: all but the last as long as fits, in units of 8 bytes (RFC 791, 3.2).

    Raises:
        ConfigurationError: It is longer than an IP packet can be.
    """
    if packet.size_bytes <= mtu_bytes:
        yield Fragment(packet, ip_id, 0, 1, 0, packet.size_bytes)
        return
    if packet.size_bytes > LONGEST_BYTES:
        raise ConfigurationError(
            f"an IP packet of {packet.size_bytes} bytes is longer than {LONGEST_BYTES} bytes",
            where=f"flow {packet.identity[0]}",
            remedy="send smaller messages, or by tcp",
        )
    carried_bytes = packet.size_bytes - HEADER_BYTES
    most_bytes = (mtu_bytes - HEADER_BYTES) // 8 * 8
    count = -(-carried_bytes // most_bytes)
    for index in range(count):
        offset_bytes = index * most_bytes
        size_bytes = HEADER_BYTES + min(most_bytes, carried_bytes - offset_bytes)
        yield Fragment(packet, ip_id, index, count, offset_bytes, size_bytes)


@dataclass(slots=True)
class _Partial:
    """What a host has of a packet: how many of its fragments arrived or will not, since when, and whether in vain."""

    packet: IpPacket
    known: int = 0
    since_ns: int | None = None
    in_vain: bool = False


class Reassembly:
    """Puts fragments together at the hosts they arrive at, each told once for each host: as arrived, or as lost.

    Args:
        lost: Called with a packet, a host and a reason once that host cannot get it any more.
    """

    def __init__(self, lost: Callable[[IpPacket, str, str], None]) -> None:
        self._lost = lost
        self._partials: dict[tuple[str, str, int], _Partial] = {}

    def arrived(self, now_ns: int, host: str, fragment: Fragment) -> bool:
        """Take a fragment that arrived at a host; return whether its packet is whole there now.

        Where the rest comes after `REASSEMBLY_NS`, it finds nothing left of the packet.
        """
        if fragment.count == 1:
            return True
        partial = self._next(host, fragment)
        if partial.since_ns is None:
            partial.since_ns = now_ns
        elif now_ns - partial.since_ns >= REASSEMBLY_NS:
            self._fail(host, partial, TIMED_OUT)
        return partial.known == fragment.count and not partial.in_vain

    def missing(self, host: str, fragment: Fragment, reason: str) -> None:
        """Take it that a fragment will not arrive at a host."""
        if fragment.count == 1:
            self._lost(fragment.packet, host, reason)
        else:
            self._fail(host, self._next(host, fragment), reason)

    def forget(self, host: str, reason: str) -> None:
        """Let what a host has of packets be of no use to it any more, as when it is switched off."""
        for (name, _, _), partial in self._partials.items():
            if name == host:
                self._fail(host, partial, reason)

    def _next(self, host: str, fragment: Fragment) -> _Partial:
        key = host, fragment.packet.source, fragment.ip_id
        partial = self._partials.pop(key, None) or _Partial(fragment.packet)
        partial.known += 1
        if partial.known < fragment.count:
            self._partials[key] = partial
        return partial

    def _fail(self, host: str, partial: _Partial, reason: str) -> None:
        if not partial.in_vain:
            partial.in_vain = True
            self._lost(partial.packet, host, reason)
