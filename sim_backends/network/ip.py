"""The internet layer: IPv4 packets are sent in fragments up to the MTU, and reassembled if all fragments arrive.

RFC 791, without options. If a fragment is lost, its whole packet is lost: this layer does not retransmit.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

from fieldkit.core.errors import ConfigurationError
from sim_backends.network.wire import IpPacket
from sim_backends.radio.core.random_streams import PacketIdentity

HEADER_BYTES: Final = 20
"""Size of the header without options (RFC 791, 3.1)."""

MAX_PACKET_BYTES: Final = 65535
"""Maximum of the total length, a field of 16 bits (RFC 791, 3.1)."""

MTU_BYTES: Final = 1500
"""Largest IP packet of a frame: Linux's default for Wi-Fi and Ethernet."""

REASSEMBLY_NS: Final = 30 * 10**9
"""Time for which Linux waits for the other fragments after the first one (net.ipv4.ipfrag_time)."""

TIMED_OUT: Final = "reassembly timed out"


@dataclass(frozen=True, slots=True)
class Fragment:
    """A fragment of an IP packet, or a whole packet.

    Attributes:
        packet: The packet.
        ip_id: Number of the packet among all packets of its source: the identification field of the header without
            its limit of 16 bits.
        index: Index of the fragment in the packet, from 0.
        count: Number of fragments of the packet.
        offset_bytes: Offset of its payload in the payload of the packet.
        size_bytes: Its size with the header.
    """

    packet: IpPacket
    ip_id: int
    index: int
    count: int
    offset_bytes: int
    size_bytes: int

    @property
    def identity(self) -> PacketIdentity:
        """Identity from which its random numbers are derived; the first fragment has the identity of the packet."""
        flow, number = self.packet.identity
        return (f"{flow} fragment {self.index}", number) if self.index else (flow, number)


def fragments(packet: IpPacket, ip_id: int, mtu_bytes: int = MTU_BYTES) -> Iterator[Fragment]:
    """Yield the fragments of a packet, or the whole packet if it is not longer than the MTU.

    The payloads of all fragments but the last have the maximum size, a multiple of 8 bytes (RFC 791, 3.2).

    Raises:
        ConfigurationError: The packet is longer than the maximum of an IP packet.
    """
    if packet.size_bytes <= mtu_bytes:
        yield Fragment(packet, ip_id, 0, 1, 0, packet.size_bytes)
        return
    if packet.size_bytes > MAX_PACKET_BYTES:
        raise ConfigurationError(
            f"an IP packet of {packet.size_bytes} bytes is longer than {MAX_PACKET_BYTES} bytes",
            where=f"flow {packet.identity[0]}",
            remedy="send smaller messages, or use tcp",
        )
    payload_bytes = packet.size_bytes - HEADER_BYTES
    max_fragment_bytes = (mtu_bytes - HEADER_BYTES) // 8 * 8
    count = -(-payload_bytes // max_fragment_bytes)
    for index in range(count):
        offset_bytes = index * max_fragment_bytes
        size_bytes = HEADER_BYTES + min(max_fragment_bytes, payload_bytes - offset_bytes)
        yield Fragment(packet, ip_id, index, count, offset_bytes, size_bytes)


@dataclass(slots=True)
class _PartialPacket:
    """State of a packet at a host.

    Attributes:
        packet: The packet.
        fragment_count: Number of its fragments that arrived or were lost.
        since_ns: Time at which the first fragment arrived; None before.
        has_failed: True if the packet was reported as lost.
    """

    packet: IpPacket
    fragment_count: int = 0
    since_ns: int | None = None
    has_failed: bool = False


class Reassembly:
    """Reassembles fragments at their receiving hosts; reports each packet once per host, as complete or as lost.

    Args:
        on_lost: Called with a packet, a host and a reason when the host can no longer receive the packet.
    """

    def __init__(self, on_lost: Callable[[IpPacket, str, str], None]) -> None:
        self._on_lost = on_lost
        self._partials: dict[tuple[str, str, int], _PartialPacket] = {}

    def on_arrival(self, now_ns: int, host: str, fragment: Fragment) -> bool:
        """Record a fragment that arrived at a host; return True if its packet is now complete there.

        If a fragment arrives `REASSEMBLY_NS` or longer after the first one, the packet is lost.
        """
        if fragment.count == 1:
            return True
        partial = self._count_fragment(host, fragment)
        if partial.since_ns is None:
            partial.since_ns = now_ns
        elif now_ns - partial.since_ns >= REASSEMBLY_NS:
            self._fail(host, partial, TIMED_OUT)
        return partial.fragment_count == fragment.count and not partial.has_failed

    def on_loss(self, host: str, fragment: Fragment, reason: str) -> None:
        """Record that a fragment will not arrive at a host."""
        if fragment.count == 1:
            self._on_lost(fragment.packet, host, reason)
        else:
            self._fail(host, self._count_fragment(host, fragment), reason)

    def discard(self, host: str, reason: str) -> None:
        """Discard the incomplete packets of a host, for example when it is switched off."""
        for (name, _, _), partial in self._partials.items():
            if name == host:
                self._fail(host, partial, reason)

    def _count_fragment(self, host: str, fragment: Fragment) -> _PartialPacket:
        key = host, fragment.packet.source, fragment.ip_id
        partial = self._partials.pop(key, None) or _PartialPacket(fragment.packet)
        partial.fragment_count += 1
        if partial.fragment_count < fragment.count:
            self._partials[key] = partial
        return partial

    def _fail(self, host: str, partial: _PartialPacket, reason: str) -> None:
        if not partial.has_failed:
            partial.has_failed = True
            self._on_lost(partial.packet, host, reason)
