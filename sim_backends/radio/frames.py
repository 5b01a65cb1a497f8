"""Packets on one hop, and the log of attempts to send them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, TypeVar

from sim_backends.radio import delay
from sim_backends.radio.air import OnAir
from sim_backends.radio.delay import Delay
from sim_backends.radio.modes import Mode

Payload = TypeVar("Payload")

HEADER_BYTES: Final = 24 + 8 + 4
"""MAC header with three addresses, LLC and SNAP, FCS: IEEE 802.11-2020, 9.3.2.1; RFC 1042."""


@dataclass(eq=False, slots=True)
class Frame(Generic[Payload]):
    """A packet on one hop.

    Attributes:
        payload: What it carries.
        size_bytes: Size of the packet, without MAC header.
        source: Who sent the packet at first.
        receiver: Index of the station at the end of this hop; None is everyone.
        onward: To whom the relay passes it on.
        keep: Whether the receiver of this hop keeps the packet.
        queued_ns: When it came to wait at the transmitter.
        before: What the packet was delayed by before this hop, 0 for nothing.
        begun_ns: When its first attempt began.
        attempts: How many there were.
    """

    payload: Payload
    size_bytes: int
    source: str
    receiver: int | None
    onward: tuple[int | None, ...]
    keep: bool
    queued_ns: int
    before: Delay = 0
    begun_ns: int = 0
    attempts: int = 0

    def delayed(self, now_ns: int, wave_ns: int) -> Delay:
        """Return what the packet was delayed by on all its hops, if it is decoded at `now_ns` after `wave_ns`."""
        waited_ns, sent_ns = self.begun_ns - self.queued_ns, now_ns - self.begun_ns
        parts = delay.QUEUING_NS * waited_ns + delay.TRANSMISSION_NS * sent_ns + delay.PROPAGATION_NS * wave_ns
        return parts + (self.before or delay.PACKET)

    def passed_on(self, now_ns: int, receiver: int | None, before: Delay) -> "Frame[Payload]":
        """Return the packet on its second hop, which the relay queues at `now_ns`."""
        return Frame(
            self.payload, self.size_bytes, self.source, receiver, (), keep=True, queued_ns=now_ns, before=before
        )


@dataclass(frozen=True)
class Attempt:
    """One transmission attempt, for a log.

    Attributes:
        start_ns: When it began.
        end_ns: When it ended.
        transmitter: Who sent.
        receiver: To whom; None is everyone.
        mode: In which mode.
        size_bytes: MAC header and FCS included.
        number: 1 for the first attempt at a frame; 0 for an ACK.
        received: Who decoded it of those it was for.
        payload: What it carried; None for an ACK.
    """

    start_ns: int
    end_ns: int
    transmitter: str
    receiver: str | None
    mode: Mode
    size_bytes: int
    number: int
    received: tuple[str, ...]
    payload: Any


def attempt(names: Sequence[str], air: OnAir, frame: Frame[Any], received: Iterable[int]) -> Attempt:
    """Return the attempt at `frame` that was `air`, decoded by those of index `received`."""
    return Attempt(
        air.start_ns,
        air.end_ns,
        names[air.transmitter],
        None if frame.receiver is None else names[frame.receiver],
        air.mode,
        air.size_bytes,
        frame.attempts,
        tuple(names[index] for index in received),
        frame.payload,
    )


def acknowledgement(names: Sequence[str], air: OnAir, receiver: int, *, decoded: bool) -> Attempt:
    """Return the ACK that was `air`, for `receiver`, as an attempt."""
    name = names[receiver]
    received = (name,) if decoded else ()
    return Attempt(
        air.start_ns, air.end_ns, names[air.transmitter], name, air.mode, air.size_bytes, 0, received, None
    )
