"""The hash over the events of a run: runs with equal digests are equal, packet by packet."""

import hashlib
import struct
from collections.abc import Iterable
from itertools import repeat
from typing import Any, Final

from sim_backends.cosim.run import Fate

_EVENT: Final = struct.Struct("<cQQ")
_PACKET: Final = struct.Struct("<QqqQQ")

_HASHED_BYTES: Final = 1 << 15
"""Events are hashed in blocks of this size, because hashing each window separately would take longer."""


class EventDigest:
    """Hashes windows in order: packets that entered the network, arrivals, drops, and the end of each window.

    A window is hashed when it is over, so a run that stops within a window has the digest of the windows before.
    States are not hashed: the last bit of a position may differ between two mathematical libraries, times may not.

    Attributes:
        quiet_ends_ns: Ends of the windows since the last window with packets. They are hashed together; for a window
            without packets, a caller may append its end here.
    """

    def __init__(self) -> None:
        self.quiet_ends_ns: list[int] = []
        self._hash = hashlib.blake2b(digest_size=16)
        self._events = bytearray()
        self._windows = 0

    def add_window(self, end_ns: int, entered: Iterable[Fate], ended: Iterable[Fate]) -> None:
        """Hash a window.

        Args:
            end_ns: Its end.
            entered: The fates of packets that entered the network, in order.
            ended: The fates that were decided in the window, in order.
        """
        self._add_quiet_windows()
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
        self.quiet_ends_ns.append(end_ns)
        if len(events) > _HASHED_BYTES:
            self._hash.update(events)
            events.clear()

    def _add_quiet_windows(self) -> None:
        """Append the ends of the quiet windows to the events."""
        ends_ns = self.quiet_ends_ns
        numbers = range(self._windows, self._windows + len(ends_ns))
        self._events += b"".join(map(_EVENT.pack, repeat(b"w"), numbers, ends_ns))
        self._windows += len(ends_ns)
        ends_ns.clear()

    def __deepcopy__(self, memo: dict[int, Any]) -> "EventDigest":
        other = EventDigest()
        other.quiet_ends_ns = self.quiet_ends_ns.copy()
        other._hash, other._events, other._windows = self._hash.copy(), self._events.copy(), self._windows
        return other

    def hexdigest(self) -> str:
        """Return the hash over all windows so far, in hexadecimal."""
        self._add_quiet_windows()
        complete = self._hash.copy()
        complete.update(self._events)
        return complete.hexdigest()
