"""Frames: packets on one hop, their transmissions, what a receiver makes of one, and the log of attempts."""

import itertools
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final, Generic

from sim_backends.radio import delay
from sim_backends.radio.delay import Delay, Payload
from sim_backends.radio.modes import WifiMode
from sim_backends.radio.packet_error import log_success
from sim_backends.radio.random_streams import PacketIdentity

PREAMBLE_SNR_DB: Final = 4.0
"""Below it a preamble is not detected: the default of ns-3's threshold model, after 802.11 implementations."""

HEADER_BYTES: Final = 24 + 8 + 4
"""MAC header with three addresses, LLC and SNAP, FCS: IEEE 802.11-2020, 9.3.2.1; RFC 1042."""

_NEVER_NS: Final = 1 << 63


@dataclass(eq=False, slots=True)
class Emission:
    """Noise that somebody sends in the whole channel.

    Attributes:
        start_ns: When it begins.
        powers_mw: How strong it arrives at each station, by index, where they are now.
        end_ns: When it ended, if it has.
    """

    start_ns: int
    powers_mw: list[float]
    end_ns: int = _NEVER_NS


@dataclass(eq=False, slots=True)
class Transmission:
    """A frame on the air.

    Attributes:
        transmitter: Index of who sends it.
        start_ns: When its preamble begins.
        end_ns: When its last symbol ends.
        mode: How its bits are sent.
        size_bytes: Its size, MAC header and FCS included.
        packet: The packet that it carries, or acknowledges.
        attempt: 1 for the first attempt at it on this hop.
        powers_mw: How strong it arrives at each station, by index; 0 at the transmitter.
        heard_by: Indices of the stations that hear it, whether they can receive it or not.
        others: Frames, and noise of jammers, that are on the air at the same time for a while.
        followed_by: Indices of the stations that receive it, not another frame or nothing.
    """

    transmitter: int
    start_ns: int
    end_ns: int
    mode: WifiMode
    size_bytes: int
    packet: PacketIdentity
    attempt: int
    powers_mw: list[float] = field(default_factory=list)
    heard_by: Sequence[int] = ()
    others: list["Transmission | Emission"] = field(default_factory=list)
    followed_by: set[int] = field(default_factory=set)


def success(frame: Transmission, receiver: int, noise_mw: float) -> float:
    """Return the probability that `receiver`, which follows a frame, decodes it.

    Its bits are spread evenly over its time; each stretch between two changes of interference has its own ratio of
    signal to interference and noise, and all bits must be right.
    """
    signal_mw = frame.powers_mw[receiver]
    bits = 8.0 * frame.size_bytes
    if not frame.others:
        return math.exp(log_success(frame.mode, decibel(signal_mw / noise_mw), bits))
    edges = {frame.start_ns, frame.end_ns}
    for other in frame.others:
        edges.update(min(max(edge, frame.start_ns), frame.end_ns) for edge in (other.start_ns, other.end_ns))
    times = sorted(edges)
    length_ns = frame.end_ns - frame.start_ns
    logarithm = 0.0
    for begin, end in itertools.pairwise(times):
        interference_mw = sum(
            other.powers_mw[receiver] for other in frame.others if other.start_ns <= begin and other.end_ns >= end
        )
        ratio_db = decibel(signal_mw / (noise_mw + interference_mw))
        logarithm += log_success(frame.mode, ratio_db, bits * (end - begin) / length_ns)
    return math.exp(logarithm)


def decibel(ratio: float) -> float:
    """Return a ratio of powers in dB, a very low number for 0."""
    return 10 * math.log10(ratio) if ratio > 0 else -1e9


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
        packet: What its draws are keyed by.
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
    packet: PacketIdentity
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
        return Frame(self.payload, self.size_bytes, self.source, receiver, (), True, self.packet, now_ns, before)


@dataclass(frozen=True)
class TransmissionAttempt:
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
    mode: WifiMode
    size_bytes: int
    number: int
    received: tuple[str, ...]
    payload: Any


def attempt(
    names: Sequence[str], transmission: Transmission, frame: Frame[Any], received: Iterable[int]
) -> TransmissionAttempt:
    """Return the attempt at `frame` that was `transmission`, decoded by those of index `received`."""
    return TransmissionAttempt(
        transmission.start_ns,
        transmission.end_ns,
        names[transmission.transmitter],
        None if frame.receiver is None else names[frame.receiver],
        transmission.mode,
        transmission.size_bytes,
        frame.attempts,
        tuple(names[index] for index in received),
        frame.payload,
    )


def acknowledgement(
    names: Sequence[str], transmission: Transmission, receiver: int, *, decoded: bool
) -> TransmissionAttempt:
    """Return the ACK that was `transmission`, for `receiver`, as an attempt."""
    name = names[receiver]
    received = (name,) if decoded else ()
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
    )
