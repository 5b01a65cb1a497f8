"""One-way delay and jitter of a transfer's packets, each seen in both captures."""

from typing import Final

import numpy as np

from fieldkit.core.columns import EITHER_WAY_S, Figure, Kind, Measured, columns
from fieldkit.core.model import Protocol
from fieldkit.measure.captures.arrays import NO_TIME, Floats, Ints, Mask
from fieldkit.measure.captures.ip import UDP
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.evidence.survivors import quantile_of_sent
from fieldkit.measure.transfers import tcp, udp
from fieldkit.measure.transfers.clocks import QUARTZ_SKEW, STAMP_S, Clocks, StampPairs, estimate
from fieldkit.measure.transfers.match import Match, match
from fieldkit.measure.transfers.ranges import Pieces
from fieldkit.measure.transfers.transfer import Transfer

COLUMNS: Final = columns(
    10,
    (
        "one_way_min_s",
        "s",
        (
            "Smallest delay of the transfer's packets from one capture to the other (TCP: frames with payload). "
            "This and the next three are empty when one_way_error_s is above a tenth of them."
        ),
    ),
    (
        "one_way_median_s",
        "s",
        "Median of that delay.",
        Figure("one-way delay", Kind.MEDIAN, rank=31, of_sent="one_way_median_sent_s"),
    ),
    ("one_way_mean_s", "s", "Mean of that delay."),
    ("one_way_p95_s", "s", "95th percentile of that delay."),
    ("one_way_error_s", "s", "The most that each of these can be wrong by the two clocks."),
    ("one_way_withheld", "text", "Why some or all of them are empty; empty when none is."),
    (
        "delay_variation_median_s",
        "s",
        "Median of the same packets' delay less that of the fastest, which needs no common clock (RFC 5481).",
        Figure("delay variation", Kind.MEDIAN, rank=32),
    ),
    ("delay_variation_p95_s", "s", "95th percentile of that."),
    (
        "jitter_s",
        "s",
        "Interarrival jitter of the same packets after the last one (RFC 3550, section 6.4.1).",
        Figure("last jitter value (RFC 3550)", Kind.MEDIAN, rank=33),
    ),
    (
        "clock_offset_s",
        "s",
        "Receiver's clock less sender's in the middle of the captures; empty without packets in both directions.",
        EITHER_WAY_S,
    ),
    ("clock_offset_error_s", "s", "The most that clock_offset_s can be wrong."),
    (
        "clock_skew_ppm",
        "ppm",
        "How much faster the receiver's clock goes; empty when it can be wrong by more than 100.",
    ),
    ("clock_skew_error_ppm", "ppm", "The most that clock_skew_ppm can be wrong."),
)
SENT_COLUMNS: Final = columns(
    110,
    (
        "one_way_median_sent_s",
        "s",
        (
            "Median one-way delay over all of the transfer's packets that were sent, one without a known arrival as "
            "later than all others; empty where that is half of them or more, and where one_way_median_s is empty."
        ),
    ),
)

LARGEST_ERROR: Final = 0.1
"""How large the error of a one-way delay may be, as a share of it: above that the delay is withheld."""

UNSTEADY: Final = "no offset and drift fit: a clock was set meanwhile, or goes wrong by more than 500 ppm"
"""Why no time of a transfer can be told, not even by one clock: nobody knows which of the two it is."""

_JITTER_GAIN: Final = 1 / 16
_REMEMBERED: Final = 1000


def udp_packets(crossing: udp.UdpPackets) -> StampPairs:
    """Return the packets of a UDP transfer that both captures hold, each fragment by itself."""
    sent, received = udp_copies(crossing)
    return StampPairs(crossing.sent.time_ns[sent], crossing.received.time_ns[received])


def udp_copies(crossing: udp.UdpPackets) -> tuple[Ints, Ints]:
    """Return the index of each packet of `udp_packets` among those sent, and among those received."""
    return _copies(crossing.match, crossing.chosen)


def tcp_frames(crossing: tcp.TcpFrames) -> StampPairs:
    """Return the frames with payload of a TCP transfer that both captures hold."""
    sent, received = tcp_copies(crossing)
    return StampPairs(crossing.sent.time_ns[sent], crossing.received.time_ns[received])


def tcp_copies(crossing: tcp.TcpFrames) -> tuple[Ints, Ints]:
    """Return the index of each frame of `tcp_frames` among those sent, and among those received.

    A frame arrives with its last byte, and what offload joined of several with that of the last.
    """
    left, came, matched = crossing.payload.sent, crossing.payload.received, crossing.payload.match
    certain = matched.arrived & ~matched.doubtful & _ends(left)
    certain[certain] = _ends(came)[matched.received_index[certain]]
    return left.frame[certain], came.frame[matched.received_index[certain]]


def tcp_sent(crossing: tcp.TcpFrames) -> int:
    """Return how many frames with payload were sent, of which `tcp_frames` are those that arrived."""
    return int(_ends(crossing.payload.sent).sum())


def _ends(pieces: Pieces) -> Mask:
    """Return which pieces are the last of their frame."""
    last: Mask = np.diff(pieces.frame, append=-1) != 0
    return last


def measure(
    own: StampPairs, sender: Packets, receiver: Packets, transfer: Transfer, *, sent: int, alike: bool = False
) -> Measured:
    """Return what both captures say of the transfer's delay, and of the receiver's clock against the sender's.

    Args:
        own: The transfer's packets, by `udp_packets` or `tcp_frames`.
        sender: Packets of the sender's capture.
        receiver: Packets of the receiver's capture.
        transfer: What tells the transfer's packets.
        sent: How many of them were sent.
        alike: Whether some of these are left out of `own`, since nothing tells them apart.
    """
    others = _others(sender, receiver, transfer)
    reverse = _reverse(sender, receiver, transfer.sender_address, transfer.receiver_address)
    if not len(own):
        return _withheld(
            "the packets of the transfer look alike" if alike else "no packet of the transfer is in both captures"
        )
    if any(
        (times == NO_TIME).any()
        for stamps in (own, others, reverse)
        for times in (stamps.sender_ns, stamps.receiver_ns)
    ):
        return _withheld("a capture lacks times")
    own = own.where(np.argsort(own.receiver_ns, kind="stable"))
    transit_ns = own.receiver_ns - own.sender_ns
    jitter = Measured.of({"jitter_s": jitter_s(transit_ns)}, "a single packet has none")
    if not len(reverse):
        variation = _variation((transit_ns - transit_ns.min()) / 1e9)
        return jitter | variation | _withheld("no packet from receiver to sender is in both captures")
    clocks = estimate(StampPairs.joined((own, others)), reverse)
    if clocks is None:
        return _withheld(UNSTEADY)
    delay_s, error_s = _delays_s(own, clocks)
    one_way = _one_way(delay_s, error_s, sent)
    return jitter | _clock(clocks) | one_way | _variation(delay_s)


def of_each(own: StampPairs, sender: Packets, receiver: Packets, transfer: Transfer) -> tuple[Floats, float] | None:
    """Return the one-way delay of each packet, and the most that each can be wrong by the clocks, in seconds.

    None where the captures do not tell one clock from the other.

    Args:
        own: The transfer's packets, all with times, as of `measure`.
        sender: Packets of the sender's capture, likewise.
        receiver: Packets of the receiver's capture, likewise.
        transfer: What tells the transfer's packets.
    """
    reverse = _reverse(sender, receiver, transfer.sender_address, transfer.receiver_address)
    if not len(own) or not len(reverse):
        return None
    clocks = estimate(StampPairs.joined((own, _others(sender, receiver, transfer))), reverse)
    return None if clocks is None else _delays_s(own, clocks)


def between(sender: Packets, receiver: Packets, sender_address: str, receiver_address: str) -> Clocks | None:
    """Return the receiver's clock against the sender's by every packet between the two, of whatever protocol.

    None where the captures do not tell: they lack times, or packets in a direction, or a clock was set meanwhile.

    Args:
        sender: Packets of the sender's capture.
        receiver: Packets of the receiver's capture.
        sender_address: Of the sender on the link under test.
        receiver_address: Of the receiver.
    """
    forward = _seen(
        *(packets.where(_is_way(packets, sender_address, receiver_address)) for packets in (sender, receiver))
    )
    reverse = _reverse(sender, receiver, sender_address, receiver_address)
    times = (forward.sender_ns, forward.receiver_ns, reverse.sender_ns, reverse.receiver_ns)
    if any(not len(stamps) or (stamps == NO_TIME).any() for stamps in times):
        return None
    return estimate(forward, reverse)


def _delays_s(own: StampPairs, clocks: Clocks) -> tuple[Floats, float]:
    """Return as `of_each`."""
    return clocks.delays_s(own.sender_ns, own.receiver_ns), clocks.error_s(own.receiver_ns) + STAMP_S


def _withheld(reason: str) -> Measured:
    """Return that no delay can be told, and why."""
    return Measured({"one_way_withheld": reason}) | Measured.nothing((*COLUMNS, *SENT_COLUMNS), reason)


def jitter_s(transit_ns: Ints) -> float | None:
    """Return the interarrival jitter of RFC 3550, section 6.4.1, after the last packet; None for a single one.

    Args:
        transit_ns: Time received less time sent of each packet, in the order of arrival, by any two clocks.
    """
    if len(transit_ns) < 2:
        return None
    # J += (|D| - J) / 16 from J = 0, written out; what is older weighs less than a float can tell.
    recent_s = np.abs(np.diff(transit_ns[-_REMEMBERED:])) / 1e9
    return float(_JITTER_GAIN * (1 - _JITTER_GAIN) ** np.arange(len(recent_s))[::-1] @ recent_s)


def mean_jitter_s(transit_ns: Ints) -> float | None:
    """Return the mean of `jitter_s` after each packet from the second on; arguments as of `jitter_s`."""
    if len(transit_ns) < 2:
        return None
    # Each |D| counts in J after it and after all later packets: the sum of its weights is a geometric series.
    steps_s = np.abs(np.diff(transit_ns)) / 1e9
    weights = 1 - (1 - _JITTER_GAIN) ** np.arange(len(steps_s), 0, -1)
    return float(weights @ steps_s) / len(steps_s)


def _variation(delay_s: Floats) -> Measured:
    """Return the packet delay variation of RFC 5481, section 4.2: over the fastest packet."""
    over_s = delay_s - delay_s.min()
    return Measured(
        {
            "delay_variation_median_s": float(np.median(over_s)),
            "delay_variation_p95_s": float(np.percentile(over_s, 95)),
        }
    )


def _clock(clocks: Clocks) -> Measured:
    values = {
        "clock_offset_s": clocks.base_ns / 1e9 + clocks.offset_s,
        "clock_offset_error_s": clocks.error_s(np.array([clocks.middle_ns])),
        "clock_skew_ppm": 1e6 * clocks.skew if clocks.skew_error <= QUARTZ_SKEW else None,
        "clock_skew_error_ppm": 1e6 * clocks.skew_error,
    }
    return Measured.of(values, "it can be wrong by more than 100 ppm")


def _one_way(delay_s: Floats, error_s: float, sent: int) -> Measured:
    figures = {
        "one_way_min_s": float(delay_s.min()),
        "one_way_median_s": float(np.median(delay_s)),
        "one_way_mean_s": float(delay_s.mean()),
        "one_way_p95_s": float(np.percentile(delay_s, 95)),
    }
    shown = {name: value if error_s <= LARGEST_ERROR * value else None for name, value in figures.items()}
    withheld = ", ".join(name.split("_")[2] for name, value in shown.items() if value is None)
    reason = f"the error is above a tenth of: {withheld}" if withheld else None
    of_sent = None if shown["one_way_median_s"] is None else quantile_of_sent(delay_s, sent, 0.5)
    return (
        Measured({"one_way_error_s": error_s})
        | Measured.of({"one_way_median_sent_s": of_sent}, "the median is withheld, or half of the packets were lost")
        | Measured.of(shown, "its error is above a tenth of it")
        | Measured.of({"one_way_withheld": reason}, "nothing is withheld")
    )


def _others(sender: Packets, receiver: Packets, transfer: Transfer) -> StampPairs:
    """Return what else went from sender to receiver: packets without payload, and ping's."""
    ends = transfer.sender_address, transfer.receiver_address
    return _seen(
        *(packets.where(_is_way(packets, *ends) & ~_is_own(packets, transfer)) for packets in (sender, receiver))
    )


def _reverse(sender: Packets, receiver: Packets, sender_address: str, receiver_address: str) -> StampPairs:
    """Return what went from receiver to sender."""
    back = _seen(
        *(packets.where(_is_way(packets, receiver_address, sender_address)) for packets in (receiver, sender))
    )
    return StampPairs(sender_ns=back.receiver_ns, receiver_ns=back.sender_ns)


def _is_way(packets: Packets, source: str, destination: str) -> Mask:
    return packets.are_from(source) & packets.are_to(destination)


def _is_own(packets: Packets, transfer: Transfer) -> Mask:
    """Return which packets may be the transfer's; of a later fragment only its datagram tells."""
    own: Mask = (
        packets.protocol == UDP
        if transfer.protocol is Protocol.UDP
        else (packets.dport == transfer.port) & (packets.tcp_payload_bytes > 0)
    )
    return own


def _seen(sent: Packets, received: Packets) -> StampPairs:
    """Return when packets were sent and received."""
    left, came = _copies(match(sent, received))
    return StampPairs(sent.time_ns[left], received.time_ns[came])


def _copies(matched: Match, chosen: Mask | None = None) -> tuple[Ints, Ints]:
    """Return where packets are among those sent and received, but for ones of which nobody can say which arrived."""
    certain = matched.arrived & ~matched.doubtful
    index = np.flatnonzero(certain if chosen is None else certain & chosen)
    return index, matched.received_index[index]
