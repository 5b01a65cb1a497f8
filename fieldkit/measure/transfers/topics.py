"""Figures of a topic by the logs of its ends and the captures around it: loss, delay, age of information, traffic.

Age of information is the time since the newest sample that has arrived was sent. It grows with time and falls when a
newer sample comes. Its mean over time is of S. Kaul, R. Yates, M. Gruteser, "Real-time status: how often should one
update?", INFOCOM 2012; its mean just before each fall, the peak age, of M. Costa, M. Codreanu, A. Ephremides, "On the
age of information in status update systems with packet management", IEEE Trans. Information Theory 62, 2016.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.columns import Figure, Kind, Measured, Value, columns
from fieldkit.measure.captures.arrays import Floats, Ints
from fieldkit.measure.captures.ip import UDP
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.evidence.survivors import quantile_of_sent
from fieldkit.measure.transfers.clocks import Clocks
from fieldkit.measure.transfers.datagrams import with_ports
from fieldkit.measure.transfers.delay import LARGEST_ERROR, between, jitter_s
from fieldkit.measure.transfers.match import match
from fieldkit.measure.transfers.topic_log import Stamped, TopicLog

_COUNTS: Final = columns(
    100,
    ("topic_sent", "count", "Samples that the publisher's middleware took."),
    ("topic_received", "count", "Of these, the ones that the subscriber got, each once."),
    (
        "topic_loss",
        "share",
        "1 - topic_received/topic_sent. Empty where nothing was sent.",
        Figure("topic loss", Kind.COUNTED, "topic_received", "topic_sent", rank=70),
    ),
    ("topic_repeated", "count", "Samples that the subscriber got more than once."),
    ("topic_refused", "count", "Samples that the publisher's middleware did not take in time."),
    ("topic_skipped", "count", "Samples that were never sent: their time passed while one before was being written."),
    (
        "topic_discovered",
        "bool",
        "Whether the publisher knew the subscription before its patience ended; if not, nothing was sent.",
        Figure("topic discovered", Kind.FLAG, rank=71),
    ),
    (
        "topic_discovery_s",
        "s",
        "From the moment at which the publisher's middleware started, its subscriber up, until it knew that.",
        Figure("topic discovery", Kind.MEDIAN, rank=72),
    ),
)
_TIMES: Final = columns(
    100,
    (
        "topic_delay_median_s",
        "s",
        (
            "Median delay from before a sample is handed to the middleware until the subscriber has it. This, the "
            "next three, and the two of age are empty where topic_delay_error_s is above a tenth of them, or unknown."
        ),
        Figure("topic delay", Kind.MEDIAN, rank=73, of_sent="topic_delay_median_sent_s"),
    ),
    ("topic_delay_mean_s", "s", "Mean of that delay."),
    (
        "topic_delay_p95_s",
        "s",
        "95th percentile of it.",
        Figure("topic delay, 95 %", Kind.MEDIAN, rank=74, of_sent="topic_delay_p95_sent_s"),
    ),
    ("topic_delay_max_s", "s", "Largest of it."),
    ("topic_delay_error_s", "s", "The most that each of these can be wrong by the two clocks, told by the captures."),
    (
        "topic_delay_variation_p95_s",
        "s",
        "95th percentile of the delay less that of the fastest sample, which needs no common clock (RFC 5481).",
        Figure("topic delay variation, 95 %", Kind.MEDIAN, rank=75),
    ),
    (
        "topic_jitter_s",
        "s",
        "Interarrival jitter after the last sample (RFC 3550, section 6.4.1).",
        Figure("topic's last jitter value (RFC 3550)", Kind.MEDIAN, rank=76),
    ),
    (
        "topic_age_mean_s",
        "s",
        "Age of information, mean over the time from the first arrival to the last (Kaul, Yates and Gruteser 2012).",
        Figure("age of information", Kind.MEDIAN, rank=77),
    ),
    (
        "topic_age_peak_s",
        "s",
        "Mean of the age just before each newer sample came (Costa, Codreanu and Ephremides 2016).",
        Figure("peak age of information", Kind.MEDIAN, rank=78),
    ),
    (
        "topic_deadline_misses",
        "count",
        "Deadlines that passed between two arrivals without one, as DDS counts them. Empty without a deadline.",
        Figure("topic deadline misses", Kind.MEAN, rank=79),
    ),
)
_TRAFFIC: Final = columns(
    100,
    ("topic_data_packets", "count", "IP packets of the topic's data and its acknowledgements at the publisher."),
    (
        "topic_data_bytes",
        "B",
        "Bytes of these with their frames' headers.",
        Figure("topic data bytes", Kind.MEAN, rank=80),
    ),
    (
        "topic_packet_loss",
        "share",
        (
            "Share of the IP packets of its data from publisher to subscriber over UDP, fragments counted singly, "
            "that the subscriber's capture does not have. Empty over TCP."
        ),
        Figure("topic packet loss", Kind.MEAN, rank=82),
    ),
    ("topic_discovery_packets", "count", "IP packets by which its ends looked for each other, at the publisher."),
    (
        "topic_discovery_bytes",
        "B",
        "Bytes of these with their frames' headers.",
        Figure("topic discovery bytes", Kind.MEAN, rank=81),
    ),
)

_OF_SENT: Final = columns(
    110,
    (
        "topic_delay_median_sent_s",
        "s",
        (
            "Median delay over all samples that were sent, a lost one as later than all others; empty where half of "
            "them or more were lost, and where topic_delay_error_s is above a tenth of it."
        ),
    ),
    ("topic_delay_p95_sent_s", "s", "95th percentile likewise; empty where about 5 % or more were lost."),
)

_WITHHELD: Final = columns(
    120,
    (
        "topic_capture_withheld",
        "text",
        (
            "Why columns that depend on the captures are empty though the repeat is valid: packets were dropped "
            "before tcpdump. Samples, losses, delay variation and jitter are of the logs alone. Empty when no "
            "packet was."
        ),
    ),
)

COLUMNS: Final = (*_COUNTS, *_TIMES, *_TRAFFIC, *_OF_SENT, *_WITHHELD)


@dataclass(frozen=True)
class TopicTraffic:
    """What tells a topic's packets, and what was asked of it.

    Attributes:
        sender_address: Of the publisher.
        receiver_address: Of the subscriber.
        data_ports: Ports of samples and their acknowledgements.
        discovery_ports: Ports by which ends look for each other.
        deadline_s: A sample is expected at least so often; None for never.
    """

    sender_address: str
    receiver_address: str
    data_ports: frozenset[int]
    discovery_ports: frozenset[int]
    deadline_s: float | None


def measure(
    flow: TopicTraffic,
    sent: TopicLog | None,
    came: TopicLog | None,
    sender: Packets | None,
    receiver: Packets | None,
) -> Measured:
    """Return every column of a topic.

    Args:
        flow: What tells its packets.
        sent: What the publisher wrote down; None where that is not whole.
        came: What the subscriber wrote down, likewise.
        sender: What the publisher's robot captured meanwhile; None where there is no whole capture.
        receiver: What the subscriber's robot did.
    """
    traffic = _packet_loss(flow, sender, receiver) | _traffic(flow, sender)
    if sent is None or came is None:
        nothing = (*_COUNTS, *_TIMES, *_OF_SENT)
        return traffic | Measured.nothing(nothing, "there are no whole logs of both ends")
    arrived = first_arrivals(came)
    clocks = None
    if sender is not None and receiver is not None:
        clocks = between(sender, receiver, flow.sender_address, flow.receiver_address)
    counts = _counts(sent, arrived, len(came.samples))
    return traffic | counts | _times(arrived, clocks, flow.deadline_s, len(sent.samples))


def without_captures(measured: Measured, reason: str) -> dict[str, str]:
    """Return the reason for each column of a topic that is missing because packets were dropped before tcpdump.

    Args:
        measured: Columns measured without the captures.
        reason: Why the captures are not used; empty if they are.
    """
    if not reason:
        return {}
    by_clocks = {column.name for column in (*_TIMES, *_OF_SENT)} - {"topic_deadline_misses"}
    names = by_clocks | {column.name for column in _TRAFFIC}
    return {name: reason for name in sorted(names) if name not in measured.values}


def withheld_mark(reason: str) -> Measured:
    """Return the column that marks a topic measured without its captures.

    Args:
        reason: Why the captures are not used; empty if they are.
    """
    return Measured.of({"topic_capture_withheld": reason or None}, "nothing is withheld")


def first_arrivals(came: TopicLog) -> Stamped:
    """Return the samples that arrived in the order of the log; of one that arrived more than once, the first."""
    _, first = np.unique(came.samples.sequence, return_index=True)
    return came.samples.where(np.sort(first))


def _counts(sent: TopicLog, arrived: Stamped, came: int) -> Measured:
    known = np.isin(arrived.sequence, sent.samples.sequence)
    received, left = int(known.sum()), len(sent.samples)
    looked_s = None
    if sent.begun_ns is not None and sent.matched_ns is not None:
        looked_s = (sent.matched_ns - sent.begun_ns) / 1e9
    values: dict[str, Value | None] = {
        "topic_sent": left,
        "topic_received": received,
        "topic_loss": 1 - received / left if left else None,
        "topic_repeated": came - len(arrived),
        "topic_refused": sent.refused,
        "topic_skipped": sent.skipped,
        "topic_discovered": sent.matched_ns is not None,
        "topic_discovery_s": looked_s,
    }
    return Measured.of(values, "the publisher found no subscription, so nothing was sent")


def _times(arrived: Stamped, clocks: Clocks | None, deadline_s: float | None, sent: int) -> Measured:
    """Return what the times of samples say, each of which has arrived once, in the order of arrival."""
    transit_ns = arrived.at_ns - arrived.sent_ns
    told: dict[str, Value | None] = {"topic_jitter_s": jitter_s(transit_ns)}
    if deadline_s is not None:
        told["topic_deadline_misses"] = misses(arrived.at_ns, deadline_s)
    if len(arrived):
        over_s = (transit_ns - transit_ns.min()) / 1e9
        told["topic_delay_variation_p95_s"] = float(np.percentile(over_s, 95))
    if len(arrived) and clocks is not None:
        told |= _by_clocks(arrived, clocks, sent)
    why = "too few samples arrived, there is no deadline, or the captures do not tell the clocks well enough"
    return Measured.of(told, why) | Measured.nothing((*_TIMES, *_OF_SENT), why)


def _by_clocks(arrived: Stamped, clocks: Clocks, sent: int) -> dict[str, float]:
    """Return delays and ages, as far as the clocks tell them well enough."""
    delay_s, error_s = clocks.delays_s(arrived.sent_ns, arrived.at_ns), clocks.error_s(arrived.at_ns)
    mean_s, peak_s = age_s((arrived.at_ns - arrived.at_ns[0]) / 1e9, delay_s)
    figures = {
        "topic_delay_median_s": float(np.median(delay_s)),
        "topic_delay_mean_s": float(delay_s.mean()),
        "topic_delay_p95_s": float(np.percentile(delay_s, 95)),
        "topic_delay_max_s": float(delay_s.max()),
        "topic_age_mean_s": mean_s,
        "topic_age_peak_s": peak_s,
        "topic_delay_median_sent_s": quantile_of_sent(delay_s, sent, 0.5),
        "topic_delay_p95_sent_s": quantile_of_sent(delay_s, sent, 0.95),
    }
    told = {name: value for name, value in figures.items() if value is not None and error_s <= LARGEST_ERROR * value}
    return {"topic_delay_error_s": error_s, **told}


def age_s(at_s: Floats, delay_s: Floats) -> tuple[float | None, float | None]:
    """Return the mean age of information over time, and the mean of its peaks.

    Args:
        at_s: When each sample arrived, in order.
        delay_s: How old it was then.

    Returns:
        The mean from the first arrival to the last, None where they are one; the peak, None without a fall.
    """
    sent_s = at_s - delay_s
    newest_s = np.maximum.accumulate(sent_s)
    fresh = np.concatenate(([True], sent_s[1:] > newest_s[:-1]))
    at_s, newest_s = at_s[fresh], newest_s[fresh]
    if len(at_s) < 2:
        return None, None
    # Between two arrivals the age rises evenly, from what it fell to.
    peaks = at_s[1:] - newest_s[:-1]
    steps = np.diff(at_s)
    mean = float(((peaks - steps / 2) * steps).sum() / steps.sum()) if steps.sum() > 0 else None
    return mean, float(peaks.mean())


def misses(at_ns: Ints, deadline_s: float) -> int:
    """Return how many deadlines passed between arrivals, one per period without a sample (DDS 1.4, section 2.2.3)."""
    gaps_s = np.diff(at_ns) / 1e9
    # A sample that comes as its deadline ends is in time.
    return int(np.maximum(np.ceil(gaps_s / deadline_s - 1e-9) - 1, 0).sum())


def _traffic(flow: TopicTraffic, sender: Packets | None) -> Measured:
    """Return what of a capture is the topic's data, and what its discovery."""
    if sender is None:
        return Measured.nothing(_TRAFFIC, "there is no whole capture of the publisher")
    data, discovery = list(flow.data_ports), list(flow.discovery_ports)
    told = with_ports(sender)
    to_data, to_discovery = np.isin(told.dport, data), np.isin(told.dport, discovery)
    of_data, of_discovery = np.isin(told.sport, data), np.isin(told.sport, discovery)
    kinds = {
        "data": to_data | (of_data & ~to_discovery),
        "discovery": to_discovery | (of_discovery & ~to_data),
    }
    found: dict[str, Value | None] = {}
    for name, mine in kinds.items():
        found[f"topic_{name}_packets"] = int(mine.sum())
        found[f"topic_{name}_bytes"] = int(sender.wire_bytes[mine].sum())
    return Measured.of(found, "")


def _packet_loss(flow: TopicTraffic, sender: Packets | None, receiver: Packets | None) -> Measured:
    """Return which share of the packets of data over UDP from publisher to subscriber did not arrive."""
    if sender is None or receiver is None:
        return Measured.of({"topic_packet_loss": None}, "there are no whole captures of both ends")

    def on_way(packets: Packets) -> Packets:
        way = packets.are_from(flow.sender_address) & packets.are_to(flow.receiver_address)
        return packets.where(way & (packets.protocol == UDP))

    left = on_way(sender)
    # At the subscriber a first fragment may be missing, and with it the port of the others: the sender's tell it.
    of_data = np.isin(with_ports(left).dport, list(flow.data_ports))
    arrived = match(left, on_way(receiver)).arrived[of_data]
    lost = 1 - float(arrived.mean()) if len(arrived) else None
    return Measured.of({"topic_packet_loss": lost}, "none of its data went over UDP")
