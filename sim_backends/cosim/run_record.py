"""The record of a run (the fate of every packet, the windows, the hash over all events), and its observers."""

import hashlib
import struct
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import repeat
from typing import Any, Final, NamedTuple, Protocol, runtime_checkable

from sim_backends.network.ip import Fragment
from sim_backends.network.packets import Packet
from sim_backends.radio.core.random_streams import PacketIdentity
from sim_backends.world.motion import State


@dataclass(slots=True)
class Fate:
    """The fate of a packet: arrived, dropped, or not decided yet.

    Attributes:
        packet: The packet, with the times when it was sent and when it entered the network.
        assumed_states: States of source and destination that the network assumed when the packet entered.
        true_states: True states of source and destination at the time of sending: the states at the last physics
            step, extrapolated at their velocity. At an acceleration a and a step h the error is at most a h^2 / 2.
        arrived_ns: Time when the network delivered the packet, or None.
        counted_ns: Time from which the arrival counts for its receiver: `arrived_ns` or the end of the window,
            depending on the policy; None if the packet has not arrived.
        late_ns: Time from `counted_ns` to the simulated time of the receiver at delivery, if that is later; otherwise
            0.
        reason: The reason why the packet was dropped; empty if it arrived or is under way.
        position_error_m: Largest error, over all pairs of the agents and fixed emitters that the ledger includes, of
            the relative position that the network assumed. None if the ledger includes only source and destination:
            then `packet_ledger.position_error_m` computes the error.
    """

    packet: Packet
    assumed_states: tuple[State, State]
    true_states: tuple[State, State]
    arrived_ns: int | None = None
    counted_ns: int | None = None
    late_ns: int = 0
    reason: str = ""
    position_error_m: float | None = field(default=None, compare=False)

    @property
    def is_decided(self) -> bool:
        """True if the packet has arrived or has been dropped."""
        return self.arrived_ns is not None or bool(self.reason)


def zero_wall_s() -> dict[str, float]:
    """Return the parts of the wall time, each 0."""
    return {"agents": 0.0, "network": 0.0, "exchange": 0.0, "wait": 0.0}


@dataclass
class Run:
    """The record of a run.

    Attributes:
        fates: The fate of every packet, by flow and number.
        windows_ns: The ends of all windows.
        wall_s: Wall time by part: `agents` (physics and programs), `network`, `exchange` (policy and coordinator),
            `wait` (time in which federates only waited).
        digest: Hash over every packet, arrival, drop and window, in order (`EventDigest`); empty before the first
            call of `Coordinator.advance` has returned.
    """

    fates: dict[PacketIdentity, Fate] = field(default_factory=dict)
    windows_ns: list[int] = field(default_factory=list)
    wall_s: dict[str, float] = field(default_factory=zero_wall_s)
    digest: str = ""


_EVENT: Final = struct.Struct("<cQQ")
"""A hashed event: its kind (`a` arrival, `d` drop, `w` window), the number of the packet or window, and a time.

The time of an arrival is when it happened, that of a drop is the end of its window, and that of a window is its end.
"""
_PACKET: Final = struct.Struct("<QqqQQ")
"""A hashed packet: its id, number in the flow, size, and the times when it was sent and entered the network."""
_HASHED_BYTES: Final = 1 << 15
"""Events are collected until they exceed this size and then hashed, because hashing each window separately would take
longer."""


class EventDigest:
    """Hashes windows in order: packets that entered the network, arrivals, drops, and the end of each window.

    A window is hashed after its end, so the digest of a run that stops within a window covers the windows before it.
    States are not hashed, because the last bit of a position may differ between two mathematical libraries. Times are
    the same with every library.

    Attributes:
        quiet_ends_ns: Ends of windows that are not hashed yet; they are hashed together. For a window without
            packets, a caller may append the end of the window here instead of calling `add_window`.
    """

    def __init__(self) -> None:
        self.quiet_ends_ns: list[int] = []
        self._hash = hashlib.blake2b(digest_size=16)
        self._events = bytearray()
        self._windows = 0

    def add_window(self, end_ns: int, entered_fates: Iterable[Fate], decided_fates: Iterable[Fate]) -> None:
        """Hash a window.

        Args:
            end_ns: Its end.
            entered_fates: The fates of packets that entered the network, in order.
            decided_fates: The fates that were decided in the window, in order.
        """
        self._add_quiet_windows()
        events = self._events
        for fate in entered_fates:
            packet = fate.packet
            flow, number = packet.identity
            events += _PACKET.pack(packet.packet_id, number, packet.size_bytes, packet.sent_ns, packet.enters_ns)
            events += f"{packet.source}\0{packet.destination}\0{flow}\0{packet.protocol}\0".encode()
        for fate in decided_fates:
            if fate.arrived_ns is None:
                events += _EVENT.pack(b"d", fate.packet.packet_id, end_ns)
                events += fate.reason.encode()
            else:
                events += _EVENT.pack(b"a", fate.packet.packet_id, fate.arrived_ns)
        self.quiet_ends_ns.append(end_ns)
        if len(events) > _HASHED_BYTES:
            self._hash_events()

    def _add_quiet_windows(self) -> None:
        """Append the ends in `quiet_ends_ns` to the events."""
        ends_ns = self.quiet_ends_ns
        numbers = range(self._windows, self._windows + len(ends_ns))
        self._events += b"".join(map(_EVENT.pack, repeat(b"w"), numbers, ends_ns))
        self._windows += len(ends_ns)
        ends_ns.clear()

    def _hash_events(self) -> None:
        self._hash.update(self._events)
        self._events.clear()

    def __deepcopy__(self, memo: dict[int, Any]) -> "EventDigest":
        duplicate = EventDigest()
        duplicate.quiet_ends_ns = self.quiet_ends_ns.copy()
        duplicate._hash, duplicate._events, duplicate._windows = self._hash.copy(), self._events.copy(), self._windows
        return duplicate

    def hexdigest(self) -> str:
        """Return the hash over all windows so far, in hexadecimal."""
        self._add_quiet_windows()
        self._hash_events()
        return self._hash.hexdigest()


class Window(NamedTuple):
    """The events of a window.

    Attributes:
        begin_ns: Its beginning.
        end_ns: Its end.
        decided_by: Reason for its length, for example a pair of agents; empty if the policy does not report it.
        entered_fates: Fates of the packets that entered the network in it, in order. Most are not decided yet; they
            are updated, and are in `decided_fates` of the window in which they are decided.
        decided_fates: Fates that were decided in it, in order.
        states: States of the agents at its end.
        assumed_states: States that the network assumed during the whole window; if the network extrapolates, the
            states at the beginning of the window (`DeadReckoned`).
        wall_s: Wall time that it took, by part, as in `Run`.
    """

    begin_ns: int
    end_ns: int
    decided_by: str
    entered_fates: Sequence[Fate]
    decided_fates: Sequence[Fate]
    states: Mapping[str, State]
    assumed_states: Mapping[str, State]
    wall_s: Mapping[str, float]


class WindowObserver(Protocol):
    """Observes a run.

    Its methods must not change their arguments. The recorded wall time does not include the time of their calls.
    """

    def begin(self, states: Mapping[str, State]) -> None:
        """Receive the states of the agents at time 0, before the first window."""
        ...

    def window(self, window: Window) -> None:
        """Receive a window, immediately after it has ended."""
        ...


@runtime_checkable
class IpObserver(Protocol):
    """An observer that also receives IP packets."""

    def log_ip(self, at_ns: int, name: str, fragment: Fragment) -> None:
        """Receive an IP packet or fragment that an agent sent or that arrived at it."""
        ...
