"""Transmissions on the air, and the probability of decoding them in noise and interference."""

import itertools
import math
from collections.abc import Sequence, Set
from dataclasses import dataclass, field
from typing import Final

from sim_backends.radio.core.random_streams import PacketIdentity
from sim_backends.radio.phy.error_rates import log_success
from sim_backends.radio.phy.modes import ACK_BYTES, WifiMode

PREAMBLE_SNR_DB: Final = 4.0
"""SNR below which a preamble is not detected: the default of ns-3's threshold model, after 802.11 implementations."""

_NEVER_NS: Final = 1 << 63
"""A time after the end of every run."""


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
        undetermined: Indices of the receivers for which it is not determined yet if they have decoded it.
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
    undetermined: Set[int] = frozenset()
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
