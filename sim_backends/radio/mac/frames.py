"""Frames: packets on one hop, and the log of attempts to send them."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Generic, Literal

from sim_backends.radio.core.links import (
    PACKET,
    PROPAGATION_NS,
    QUEUING_NS,
    TRANSMISSION_NS,
    Delay,
    Payload,
)
from sim_backends.radio.core.random_streams import PacketIdentity
from sim_backends.radio.phy.modes import SHORT_RETRY_LIMIT, WifiMode
from sim_backends.radio.phy.transmissions import Transmission

HEADER_BYTES: Final = 24 + 8 + 4
"""MAC header with three addresses, LLC and SNAP, FCS: IEEE 802.11-2020, 9.3.2.1; RFC 1042."""

ControlFrame = Literal["", "ACK", "RTS", "CTS"]


@dataclass(eq=False, slots=True)
class Frame(Generic[Payload]):
    """A packet on one hop.

    Attributes:
        payload: Its content.
        size_bytes: Size of the packet, without MAC header.
        source: Name of the original sender.
        receiver: Index of the station at the end of this hop; None for a broadcast.
        forward_to: Receivers to which the relay forwards it, each an index or None for a broadcast; empty if it is
            not forwarded.
        is_for_receiver: True if the packet is delivered to the receiver of this hop.
        packet: Identity of the packet, from which its random numbers are derived.
        queued_ns: Time at which it entered the transmitter's queue.
        before: Sum of the delays before this hop, in the packed form of `links.Delay`; 0 for none.
        first_attempt_ns: Start of its first attempt; 0 before it.
        attempts: Number of attempts that have started.
        sequence: Its number in a Block Ack session; -1 before its first attempt, or without a session.
        is_received: True if the receiver of a Block Ack session has decoded it.
        max_attempts: Number of attempts after which it is given up.
        dscp: DSCP of the packet.
        category: Its access category at the station that sends it; 0 (best effort) without access categories.
    """

    payload: Payload
    size_bytes: int
    source: str
    receiver: int | None
    forward_to: tuple[int | None, ...]
    is_for_receiver: bool
    packet: PacketIdentity
    queued_ns: int
    before: Delay = 0
    first_attempt_ns: int = 0
    attempts: int = 0
    sequence: int = -1
    is_received: bool = False
    max_attempts: int = SHORT_RETRY_LIMIT
    dscp: int = 0
    category: int = 0

    def total_delay(self, now_ns: int, propagation_ns: int) -> Delay:
        """Return the delay over this and all earlier hops, for a frame that is decoded at `now_ns`."""
        queuing_ns, transmission_ns = self.first_attempt_ns - self.queued_ns, now_ns - self.first_attempt_ns
        parts = QUEUING_NS * queuing_ns + TRANSMISSION_NS * transmission_ns + PROPAGATION_NS * propagation_ns
        return parts + (self.before or PACKET)

    def for_second_hop(self, now_ns: int, receiver: int | None, before: Delay) -> "Frame[Payload]":
        """Return the packet as a frame of its second hop, which the relay queues at `now_ns`."""
        frame = Frame(self.payload, self.size_bytes, self.source, receiver, (), True, self.packet, now_ns, before)
        frame.dscp = self.dscp
        return frame


@dataclass(frozen=True)
class TransmissionAttempt:
    """One transmission attempt, for a log.

    Attributes:
        start_ns: Start time.
        end_ns: End time.
        transmitter: Name of the sender.
        receiver: Name of the receiver; None for a broadcast.
        mode: Modulation and coding.
        size_bytes: Size with MAC header and FCS.
        number: Number of the attempt for this frame, from 1; 0 for a control frame.
        received: Names of the addressed stations that decoded it.
        payload: Its content; None for a control frame.
        control: Kind of a control frame; ACK includes Block Ack. Empty for data.
    """

    start_ns: int
    end_ns: int
    transmitter: str
    receiver: str | None
    mode: WifiMode
    size_bytes: int
    number: int
    received: tuple[str, ...]
    payload: Any
    control: ControlFrame = ""


def attempt_record(
    names: Sequence[str], transmission: Transmission, frame: Frame[Any], received: Iterable[int], size_bytes: int
) -> TransmissionAttempt:
    """Return the log entry of an attempt at `frame`, decoded by the stations with the indices `received`.

    `size_bytes` is its size with MAC header and FCS. Each frame of an aggregate has the times of the aggregate.
    """
    return TransmissionAttempt(
        transmission.start_ns,
        transmission.end_ns,
        names[transmission.transmitter],
        None if frame.receiver is None else names[frame.receiver],
        transmission.mode,
        size_bytes,
        frame.attempts,
        tuple(names[index] for index in received),
        frame.payload,
    )


def control_record(
    names: Sequence[str], transmission: Transmission, receiver: int, kind: ControlFrame, *, is_decoded: bool
) -> TransmissionAttempt:
    """Return the log entry of a control frame for `receiver`."""
    name = names[receiver]
    received = (name,) if is_decoded else ()
    return TransmissionAttempt(
        transmission.start_ns,
        transmission.end_ns,
        names[transmission.transmitter],
        name,
        transmission.mode,
        transmission.size_bytes,
        0,
        received,
        None,
        kind,
    )
