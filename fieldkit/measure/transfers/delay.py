"""One-way delay and jitter of a transfer's packets, from packets in both captures."""

import math
from typing import Final

import numpy as np

from fieldkit.core.columns import CLOCK_DIFFERENCE_BOUNDS_S, Figure, Kind, Measured, columns
from fieldkit.core.model import Protocol
from fieldkit.measure.captures.arrays import NO_TIME, Floats, Ints, Mask
from fieldkit.measure.captures.headers import UDP
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.evidence.delay_quantiles import quantile_of_sent
from fieldkit.measure.transfers import tcp, udp
from fieldkit.measure.transfers.clock_offset import QUARTZ_SKEW, STAMP_S, Clocks, StampPairs, estimate
from fieldkit.measure.transfers.match import Match, match
from fieldkit.measure.transfers.tcp_streams import Pieces
from fieldkit.measure.transfers.transfer_spec import Transfer

COLUMNS: Final = columns(
    10,
    (
        "one_way_min_s",
        "s",
        (
            "Smallest one-way delay of the transfer's packets between the two captures (TCP: frames with payload). "
            "A column of one-way delays is empty if one_way_error_s is above a tenth of its value."
        ),
    ),
    (
        "one_way_median_s",
        "s",
        "Median one-way delay; empty if its error is too large, see one_way_min_s.",
        Figure("one-way delay", Kind.MEDIAN, rank=31, of_sent="one_way_median_sent_s"),
    ),
    ("one_way_mean_s", "s", "Mean one-way delay; empty if its error is too large, see one_way_min_s."),
    (
        "one_way_p95_s",
        "s",
        "95th percentile of the one-way delay; empty if its error is too large, see one_way_min_s.",
    ),
    ("one_way_error_s", "s", "Maximum error of the one-way delays that is caused by the clocks."),
    ("one_way_withheld", "text", "Reason why one-way delays are empty; empty if all of them have a value."),
    (
        "delay_variation_median_s",
        "s",
        "Median delay of the transfer's packets relative to the fastest packet; needs no common clock (RFC 5481).",
        Figure("delay variation", Kind.MEDIAN, rank=32),
    ),
    ("delay_variation_p95_s", "s", "95th percentile of the delay relative to the fastest packet (RFC 5481)."),
    (
        "jitter_s",
        "s",
        "Interarrival jitter of the transfer's packets after the last packet (RFC 3550, section 6.4.1).",
        Figure("last jitter value (RFC 3550)", Kind.MEDIAN, rank=33),
    ),
    (
        "clock_offset_s",
        "s",
        "Receiver's clock minus sender's in the middle of the captures; empty without packets in both directions.",
        CLOCK_DIFFERENCE_BOUNDS_S,
    ),
    ("clock_offset_error_s", "s", "Maximum error of clock_offset_s."),
    (
        "clock_skew_ppm",
        "ppm",
        (
            "Skew of the receiver's clock relative to the sender's; positive if the receiver's clock is faster. "
            "Empty if its error can be above 100 ppm."
        ),
    ),
    ("clock_skew_error_ppm", "ppm", "Maximum error of clock_skew_ppm."),
)
SENT_COLUMNS: Final = columns(
    110,
    (
        "one_way_median_sent_s",
        "s",
        (
            "Median one-way delay of all packets sent; a packet without a known arrival counts as later than all "
            "others. Empty if half of the packets or more have no known arrival, and if one_way_median_s is empty."
        ),
    ),
)

LARGEST_ERROR: Final = 0.1
"""Maximum error of a one-way delay as a share of the delay. With a larger error, the column of the delay is empty."""

UNSTEADY: Final = (
    "no offset and drift fit all times: a clock was set during the attempt, or drifts by more than 500 ppm"
)
"""Reason why no times of a transfer are known. Times by a single clock are also unknown, because either clock may be
the wrong one.
"""

SINGLE_PACKET: Final = "one direction has a single packet in both captures, and no other packet confirms its time"
"""Reason why the error of the clock offset is unlimited."""

_JITTER_GAIN: Final = 1 / 16
"""Weight of the newest step in the interarrival jitter of RFC 3550."""
_WEIGHTED_STEPS: Final = 1000
"""Number of steps that are used; the weight of older steps is below 1e-29."""


def udp_pairs(packets: udp.UdpPackets) -> StampPairs:
    """Return the times of a UDP transfer's packets that are in both captures. Each fragment is a packet."""
    sent, received = udp_pair_indices(packets)
    return StampPairs(packets.sent.time_ns[sent], packets.received.time_ns[received])


def udp_pair_indices(packets: udp.UdpPackets) -> tuple[Ints, Ints]:
    """Return the indices of the pairs of `udp_pairs` among the sent and among the received packets."""
    return _pair_indices(packets.match, packets.is_transfer_packet)


def tcp_pairs(frames: tcp.TcpFrames) -> StampPairs:
    """Return the times of a TCP transfer's frames with payload that are in both captures."""
    sent, received = tcp_pair_indices(frames)
    return StampPairs(frames.sent.time_ns[sent], frames.received.time_ns[received])


def tcp_pair_indices(frames: tcp.TcpFrames) -> tuple[Ints, Ints]:
    """Return the indices of the pairs of `tcp_pairs` among the sent and among the received frames.

    A frame arrives with its last byte. If offload joined several frames, the joined frame matches the last of them.
    """
    sent_pieces, received_pieces, matched = frames.payload.sent, frames.payload.received, frames.payload.match
    is_certain = matched.arrived & ~matched.ambiguous & _is_last_piece(sent_pieces)
    # Keep only the pieces that match the last piece of a received frame.
    is_certain[is_certain] = _is_last_piece(received_pieces)[matched.received_index[is_certain]]
    return sent_pieces.frame[is_certain], received_pieces.frame[matched.received_index[is_certain]]


def count_tcp_sent(frames: tcp.TcpFrames) -> int:
    """Return the number of frames with payload that were sent, including frames that did not arrive."""
    return int(_is_last_piece(frames.payload.sent).sum())


def _is_last_piece(pieces: Pieces) -> Mask:
    """Return a mask of the pieces that are the last of their frame."""
    last: Mask = np.diff(pieces.frame, append=-1) != 0
    return last


def measure(
    pairs: StampPairs, sender: Packets, receiver: Packets, transfer: Transfer, *, sent: int, ambiguous: bool = False
) -> Measured:
    """Return the columns of the transfer's delay and of the clock offset.

    Args:
        pairs: The transfer's packets, from `udp_pairs` or `tcp_pairs`.
        sender: Packets of the sender's capture.
        receiver: Packets of the receiver's capture.
        transfer: Identifies the transfer's packets.
        sent: Number of packets that the sender sent.
        ambiguous: True if some packets are missing in `pairs` because they are ambiguous.
    """
    other_pairs = _other_pairs(sender, receiver, transfer)
    reverse_pairs = _reverse_pairs(sender, receiver, transfer.sender_address, transfer.receiver_address)
    if not len(pairs):
        return _withheld(
            "the packets of the transfer cannot be distinguished"
            if ambiguous
            else "no packet of the transfer is in both captures"
        )
    if any(
        (times == NO_TIME).any()
        for stamps in (pairs, other_pairs, reverse_pairs)
        for times in (stamps.sender_ns, stamps.receiver_ns)
    ):
        return _withheld("a capture lacks times")
    pairs = pairs.where(np.argsort(pairs.receiver_ns, kind="stable"))
    transit_ns = pairs.receiver_ns - pairs.sender_ns
    jitter = Measured.from_optional({"jitter_s": jitter_s(transit_ns)}, "a single packet has no jitter")
    if not len(reverse_pairs):
        variation = _variation((transit_ns - transit_ns.min()) / 1e9)
        return jitter | variation | _withheld("no packet from receiver to sender is in both captures")
    clocks = estimate(StampPairs.concatenated((pairs, other_pairs)), reverse_pairs)
    if clocks is None:
        return _withheld(UNSTEADY)
    delay_s, error_s = _delays_s(pairs, clocks)
    one_way = _one_way(delay_s, error_s, sent)
    return jitter | _clock(clocks) | one_way | _variation(delay_s)


def packet_delays(
    pairs: StampPairs, sender: Packets, receiver: Packets, transfer: Transfer
) -> tuple[Floats, float] | None:
    """Return the one-way delay of each packet and the maximum error that the clocks cause, in seconds.

    Return None if the clock offset cannot be estimated, or if its error is unlimited.

    Args:
        pairs: The transfer's packets, from `udp_pairs` or `tcp_pairs`; all must have times.
        sender: Packets of the sender's capture, all with times.
        receiver: Packets of the receiver's capture, all with times.
        transfer: Identifies the transfer's packets.
    """
    reverse = _reverse_pairs(sender, receiver, transfer.sender_address, transfer.receiver_address)
    if not len(pairs) or not len(reverse):
        return None
    clocks = estimate(StampPairs.concatenated((pairs, _other_pairs(sender, receiver, transfer))), reverse)
    delays = None if clocks is None else _delays_s(pairs, clocks)
    return delays if delays and math.isfinite(delays[1]) else None


def clocks_between(sender: Packets, receiver: Packets, sender_address: str, receiver_address: str) -> Clocks | None:
    """Return the offset between two robots' clocks, estimated from all packets between them, of any protocol.

    Return None if a packet lacks a time, if no packet of one direction is in both captures, or if `estimate` returns
    None.

    Args:
        sender: Packets of the sender's capture.
        receiver: Packets of the receiver's capture.
        sender_address: Address of the sender on the link under test.
        receiver_address: Address of the receiver on the link under test.
    """
    forward = _matched_pairs(
        *(packets.where(_is_between(packets, sender_address, receiver_address)) for packets in (sender, receiver))
    )
    reverse = _reverse_pairs(sender, receiver, sender_address, receiver_address)
    times = (forward.sender_ns, forward.receiver_ns, reverse.sender_ns, reverse.receiver_ns)
    if any(not len(stamps) or (stamps == NO_TIME).any() for stamps in times):
        return None
    return estimate(forward, reverse)


def _delays_s(pairs: StampPairs, clocks: Clocks) -> tuple[Floats, float]:
    """Return the one-way delay of each pair and the maximum error that the clocks cause, in seconds."""
    return clocks.delays_s(pairs.sender_ns, pairs.receiver_ns), clocks.error_s(pairs.receiver_ns) + STAMP_S


def _withheld(reason: str) -> Measured:
    """Return empty columns with the reason."""
    return Measured({"one_way_withheld": reason}) | Measured.all_missing((*COLUMNS, *SENT_COLUMNS), reason)


def jitter_s(transit_ns: Ints) -> float | None:
    """Return the interarrival jitter of RFC 3550, section 6.4.1, after the last packet.

    None for fewer than two packets.

    Args:
        transit_ns: Time of reception minus time of sending of each packet, in the order of arrival, by any two
            clocks.
    """
    if len(transit_ns) < 2:
        return None
    # Closed form of J += (|D| - J) / 16 from J = 0. Older steps have weights below the precision of a float.
    recent_s = np.abs(np.diff(transit_ns[-_WEIGHTED_STEPS:])) / 1e9
    return float(_JITTER_GAIN * (1 - _JITTER_GAIN) ** np.arange(len(recent_s))[::-1] @ recent_s)


def mean_jitter_s(transit_ns: Ints) -> float | None:
    """Return the mean of the values that `jitter_s` has after each packet from the second on.

    None for fewer than two packets. The argument is the same as for `jitter_s`.
    """
    if len(transit_ns) < 2:
        return None
    # Each |D| contributes to J after its packet and after all later packets: its total weight is a geometric series.
    steps_s = np.abs(np.diff(transit_ns)) / 1e9
    weights = 1 - (1 - _JITTER_GAIN) ** np.arange(len(steps_s), 0, -1)
    return float(weights @ steps_s) / len(steps_s)


def _variation(delay_s: Floats) -> Measured:
    """Return the packet delay variation of RFC 5481, section 4.2, relative to the fastest packet."""
    variation_s = delay_s - delay_s.min()
    return Measured(
        {
            "delay_variation_median_s": float(np.median(variation_s)),
            "delay_variation_p95_s": float(np.percentile(variation_s, 95)),
        }
    )


def _clock(clocks: Clocks) -> Measured:
    error_s = clocks.error_s(np.array([clocks.middle_ns]))
    if not math.isfinite(error_s):
        names = ("clock_offset_s", "clock_offset_error_s", "clock_skew_ppm", "clock_skew_error_ppm")
        return Measured({}, dict.fromkeys(names, SINGLE_PACKET))
    values = {
        "clock_offset_s": clocks.base_ns / 1e9 + clocks.offset_s,
        "clock_offset_error_s": error_s,
        "clock_skew_ppm": 1e6 * clocks.skew if clocks.skew_error <= QUARTZ_SKEW else None,
        "clock_skew_error_ppm": 1e6 * clocks.skew_error,
    }
    return Measured.from_optional(values, "its error can be above 100 ppm")


def _one_way(delay_s: Floats, error_s: float, sent: int) -> Measured:
    """Return the columns of the one-way delay; a column whose error is too large is empty."""
    figures = {
        "one_way_min_s": float(delay_s.min()),
        "one_way_median_s": float(np.median(delay_s)),
        "one_way_mean_s": float(delay_s.mean()),
        "one_way_p95_s": float(np.percentile(delay_s, 95)),
    }
    if not math.isfinite(error_s):
        names = (*figures, "one_way_error_s", "one_way_median_sent_s")
        return Measured({"one_way_withheld": SINGLE_PACKET}, dict.fromkeys(names, SINGLE_PACKET))
    values = {name: value if error_s <= LARGEST_ERROR * value else None for name, value in figures.items()}
    # The third word of a name such as `one_way_median_s` is the statistic.
    withheld_names = ", ".join(name.split("_")[2] for name, value in values.items() if value is None)
    reason = f"the error is above a tenth of: {withheld_names}" if withheld_names else None
    of_sent = None if values["one_way_median_s"] is None else quantile_of_sent(delay_s, sent, 0.5)
    return (
        Measured({"one_way_error_s": error_s})
        | Measured.from_optional(
            {"one_way_median_sent_s": of_sent},
            "the error of the median is too large, or half of the packets were lost",
        )
        | Measured.from_optional(values, "its error is above a tenth of its value")
        | Measured.from_optional({"one_way_withheld": reason}, "no one-way delay is empty")
    )


def _other_pairs(sender: Packets, receiver: Packets, transfer: Transfer) -> StampPairs:
    """Return the times of the packets from sender to receiver that certainly do not belong to the transfer.

    These are packets of other protocols such as ping and, for a TCP transfer, packets to other ports or without
    payload.
    """
    ends = transfer.sender_address, transfer.receiver_address
    return _matched_pairs(
        *(
            packets.where(_is_between(packets, *ends) & ~_may_be_transfer(packets, transfer))
            for packets in (sender, receiver)
        )
    )


def _reverse_pairs(sender: Packets, receiver: Packets, sender_address: str, receiver_address: str) -> StampPairs:
    """Return the times of the packets from receiver to sender."""
    pairs = _matched_pairs(
        *(packets.where(_is_between(packets, receiver_address, sender_address)) for packets in (receiver, sender))
    )
    return StampPairs(sender_ns=pairs.receiver_ns, receiver_ns=pairs.sender_ns)


def _is_between(packets: Packets, source: str, destination: str) -> Mask:
    return packets.are_from(source) & packets.are_to(destination)


def _may_be_transfer(packets: Packets, transfer: Transfer) -> Mask:
    """Return a mask of the packets that may belong to the transfer; a later UDP fragment has no port."""
    mask: Mask = (
        packets.protocol == UDP
        if transfer.protocol is Protocol.UDP
        else (packets.dport == transfer.port) & (packets.tcp_payload_bytes > 0)
    )
    return mask


def _matched_pairs(sent: Packets, received: Packets) -> StampPairs:
    """Return the times of the packets that are in both lists.

    Each received frame is in one pair, so that a wrong time of the frame affects only one pair. If offload joined
    several sent frames into a received frame, the pair contains the last sent frame, which gives the strictest bound
    of the clock offset.
    """
    sent_index, received_index = _pair_indices(match(sent, received))
    received_index, last = np.unique(received_index[::-1], return_index=True)
    sent_index = sent_index[::-1][last]
    return StampPairs(sent.time_ns[sent_index], received.time_ns[received_index])


def _pair_indices(matched: Match, selection: Mask | None = None) -> tuple[Ints, Ints]:
    """Return the indices of matched packets among the sent and the received packets; ambiguous packets are omitted.

    Args:
        matched: The match.
        selection: Mask of the sent packets to include; None for all.
    """
    is_certain = matched.arrived & ~matched.ambiguous
    index = np.flatnonzero(is_certain if selection is None else is_certain & selection)
    return index, matched.received_index[index]
