"""The hash over the events of a run: two runs with the same digest are the same run, packet by packet."""

import hashlib
import struct
from collections.abc import Iterable
from itertools import repeat
from typing import Any, Final

from sim_backends.cosim.run import Fate

_EVENT: Final = struct.Struct("<cQQ")
_PACKET: Final = struct.Struct("<QqqQQ")

_HASHED_BYTES: Final = 1 << 15
"""At once: a call for every window would take longer than its hashing."""


class EventDigest:
    """Hashes windows one after the other: what entered the network, what arrived, what was dropped, and the end.

    A window is hashed when it is over, so that a run that ends within one has the digest of those before. States
    are left out: the last bit of a position may differ between two mathematical libraries, times may not.

    Attributes:
        quiet_ns: The ends of windows since the last with packets, which are hashed together; who has another window
            without packets may append its end.
    """

    def __init__(self) -> None:
        self.quiet_ns: list[int] = []
        self._hash = hashlib.blake2b(digest_size=16)
        self._events = bytearray()
        self._windows = 0

    def window(self, end_ns: int, entered: Iterable[Fate], ended: Iterable[Fate]) -> None:
        """Hash a window.

        Args:
            end_ns: When it ended.
            entered: The fates of packets that the network got, in order.
            ended: Those that were decided in it, in order.
        """
        self._take_in()
        events = self._events
        for fate in entered:
            packet = fate.packet
            flow, number = packet.identity
            events += _PACKET.pack(packet.packet_id, number, packet.size_bytes, packet.sent_ns, packet.enters_ns)
            events += f"{packet.source}\0{packet.destination}\0{flow}\0{packet.protocol}\0".encode()
        for fate in ended:
            if fate.arrived_ns is None:
                events += _EVENT.pack(b"d", fate.packet.packet_id, end_ns)
                events += fate.reason.encode()
            else:
                events += _EVENT.pack(b"a", fate.packet.packet_id, fate.arrived_ns)
        self.quiet_ns.append(end_ns)
        if len(events) > _HASHED_BYTES:
            self._hash.update(events)
            events.clear()

    def _take_in(self) -> None:
        """Let the ends of quiet windows stand among the events."""
        ends_ns = self.quiet_ns
        numbers = range(self._windows, self._windows + len(ends_ns))
        self._events += b"".join(map(_EVENT.pack, repeat(b"w"), numbers, ends_ns))
        self._windows += len(ends_ns)
        ends_ns.clear()

    def __deepcopy__(self, memo: dict[int, Any]) -> "EventDigest":
        other = EventDigest()
        other.quiet_ns = self.quiet_ns.copy()
        other._hash, other._events, other._windows = self._hash.copy(), self._events.copy(), self._windows
        return other

    def hexdigest(self) -> str:
        """Return the hash over all windows so far, in hexadecimal."""
        self._take_in()
        found = self._hash.copy()
        found.update(self._events)
        return found.hexdigest()
