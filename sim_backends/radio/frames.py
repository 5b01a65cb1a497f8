"""Frames: packets on one hop, their transmissions, the probability of decoding them, and the log of attempts."""

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Generic, Literal

from sim_backends.radio.error_rates import log_success
from sim_backends.radio.links import (
    PACKET,
    PROPAGATION_NS,
    QUEUING_NS,
    TRANSMISSION_NS,
    Delay,
    Payload,
)
from sim_backends.radio.modes import ACK_BYTES, SHORT_RETRY_LIMIT, WifiMode
from sim_backends.radio.random_streams import PacketIdentity

PREAMBLE_SNR_DB: Final = 4.0
"""SNR below which a preamble is not detected: the default of ns-3's threshold model, after 802.11 implementations."""

HEADER_BYTES: Final = 24 + 8 + 4
"""MAC header with three addresses, LLC and SNAP, FCS: IEEE 802.11-2020, 9.3.2.1; RFC 1042."""

_NEVER_NS: Final = 1 << 63
"""A time after the end of every run."""

ControlFrame = Literal["", "ACK", "RTS", "CTS"]


@dataclass(eq=False, slots=True)
class Emission:
    """Noise that a jammer or an oven sends in the whole channel.

    Attributes:
        start_ns: Start time.
        powers_mw: Current received power at each station, by index.
        end_ns: End time, in the distant future while the noise continues.
    """

    start_ns: int
    powers_mw: list[float]
    end_ns: int = _NEVER_NS


@dataclass(eq=False, slots=True)
class Transmission:
    """A frame or an aggregate on the air.

    Attributes:
        transmitter: Index of the sending station.
        start_ns: Start of its preamble.
        end_ns: End of its last symbol.
        mode: Modulation and coding.
        size_bytes: Size with MAC header and FCS.
        packet: The packet that it carries, acknowledges or announces (RTS, CTS); the first one of several.
        attempt: Number of the transmission attempt on this hop, from 1.
        powers_mw: Received power at each station, by index; 0 at the transmitter.
        detected_by: Indices of the stations that detect it, whether or not they can receive it.
        interferers: Frames and jammer noise that overlap it in time.
        receivers: Indices of the stations that are synchronized to it, and so receive it.
        response_bytes: Size of the ACK or Block Ack to it.
        frame_count: Number of frames, if it is an aggregate.
        weakest_ratio: Smallest ratio of signal to noise in 20 MHz at the stations that detect it; infinite if none
            detects it.
    """

    transmitter: int
    start_ns: int
    end_ns: int
    mode: WifiMode
    size_bytes: int
    packet: PacketIdentity
    attempt: int
    powers_mw: list[float] = field(default_factory=list)
    detected_by: Sequence[int] = ()
    interferers: list["Transmission | Emission"] = field(default_factory=list)
    receivers: set[int] = field(default_factory=set)
    response_bytes: int = ACK_BYTES
    frame_count: int = 1
    weakest_ratio: float = math.inf


def success_probability(frame: Transmission, receiver: int, noise_mw: float) -> float:
    """Return the probability that `receiver`, which is synchronized to the frame, decodes it.

    The bits are spread evenly over the frame's duration. Each interval between two changes of interference has its
    own ratio of signal to interference and noise, and all bits must be correct.

    Args:
        frame: The frame.
        receiver: Index of the receiver.
        noise_mw: Its noise power in 20 MHz.
    """
    bits = 8.0 * frame.size_bytes
    if not frame.interferers:  # true for most frames; a call of part_success_probability would take longer
        mode = frame.mode
        return math.exp(log_success(mode, decibel(frame.powers_mw[receiver] / (noise_mw * mode.noise_factor)), bits))
    return part_success_probability(frame, receiver, noise_mw, (frame.start_ns, frame.end_ns), bits)


def part_success_probability(
    frame: Transmission, receiver: int, noise_mw: float, part_ns: tuple[int, int], bits: float
) -> float:
    """Return the probability that the bits that a frame carries between two times are decoded."""
    start_ns, end_ns = part_ns
    signal_mw = frame.powers_mw[receiver]
    noise_mw *= frame.mode.noise_factor
    if not frame.interferers:
        return math.exp(log_success(frame.mode, decibel(signal_mw / noise_mw), bits))
    edges = {start_ns, end_ns}
    for other in frame.interferers:
        edges.update(min(max(edge, start_ns), end_ns) for edge in (other.start_ns, other.end_ns))
    times = sorted(edges)
    length_ns = end_ns - start_ns
    logarithm = 0.0
    for start, end in itertools.pairwise(times):
        interference_mw = sum(
            other.powers_mw[receiver]
            for other in frame.interferers
            if other.start_ns <= start and other.end_ns >= end
        )
        ratio_db = decibel(signal_mw / (noise_mw + interference_mw))
        logarithm += log_success(frame.mode, ratio_db, bits * (end - start) / length_ns)
    return math.exp(logarithm)


def decibel(ratio: float) -> float:
    """Return a power ratio in dB; -1e9 for a ratio of 0."""
    return 10 * math.log10(ratio) if ratio > 0 else -1e9


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
