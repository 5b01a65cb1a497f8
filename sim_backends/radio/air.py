"""Frames on the air: what overlaps them, what each receiver makes of them."""

import itertools
import math
from dataclasses import dataclass, field
from typing import Final

from sim_backends.radio.modes import Mode
from sim_backends.radio.packet_error import log_success

PREAMBLE_SNR_DB: Final = 4.0
"""Below it a preamble is not detected: the default of ns-3's threshold model, after 802.11 implementations."""


@dataclass(eq=False, slots=True)
class OnAir:
    """A frame on the air.

    Attributes:
        transmitter: Index of who sends it.
        start_ns: When its preamble begins.
        end_ns: When its last symbol ends.
        mode: How its bits are sent.
        size_bytes: Its size, MAC header and FCS included.
        powers_mw: How strong it arrives at each station, by index; 0 at the transmitter.
        heard_by: Indices of the stations that hear it, whether they can receive it or not.
        others: Frames that are on the air at the same time for a while.
        followed_by: Indices of the stations that receive it, not another frame or nothing.
    """

    transmitter: int
    start_ns: int
    end_ns: int
    mode: Mode
    size_bytes: int
    powers_mw: list[float] = field(default_factory=list)
    heard_by: tuple[int, ...] = ()
    others: list["OnAir"] = field(default_factory=list)
    followed_by: set[int] = field(default_factory=set)


def success(frame: OnAir, receiver: int, noise_mw: float) -> float:
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
