"""Columns of a topic from the logs of its ends and the captures: loss, delay, age of information, traffic.

Age of information is the time since the newest sample that has arrived was sent. It increases with time and drops
when a newer sample arrives. Mean over time: S. Kaul, R. Yates, M. Gruteser, "Real-time status: how often should one
update?", INFOCOM 2012. Mean just before each drop, the peak age: M. Costa, M. Codreanu, A. Ephremides, "On the age of
information in status update systems with packet management", IEEE Trans. Information Theory 62, 2016.
"""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.columns import Figure, Kind, Measured, Value, columns
from fieldkit.measure.captures.arrays import Floats, Ints
from fieldkit.measure.captures.headers import UDP
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.evidence.delay_quantiles import quantile_of_sent
from fieldkit.measure.transfers.clock_offset import Clocks
from fieldkit.measure.transfers.delay import LARGEST_ERROR, clocks_between, jitter_s
from fieldkit.measure.transfers.match import match
from fieldkit.measure.transfers.udp import with_ports
from fieldkit.ros.streams.topic_samples import TopicLog, TopicSamples

_COUNTS: Final = columns(
    100,
    ("topic_sent", "count", "Samples that the publisher's middleware accepted."),
    ("topic_received", "count", "Samples of topic_sent that the subscriber received, each counted once."),
    (
        "topic_loss",
        "share",
        "1 - topic_received/topic_sent. Empty if nothing was sent.",
        Figure("topic loss", Kind.COUNTED, "topic_received", "topic_sent", rank=70),
    ),
    ("topic_repeated", "count", "Samples that the subscriber received more than once."),
    ("topic_refused", "count", "Samples that the publisher's middleware did not accept in time."),
    ("topic_skipped", "count", "Samples that were never sent, because writing an earlier one took too long."),
    (
        "topic_discovered",
        "bool",
        "True if the publisher discovered the subscription before its timeout; if not, nothing was sent.",
        Figure("topic discovered", Kind.FLAG, rank=71),
    ),
    (
        "topic_discovery_s",
        "s",
        "Time from the start of the publisher's middleware until it discovered the subscription.",
        Figure("topic discovery", Kind.MEDIAN, rank=72),
    ),
)
_TIMES: Final = columns(
    100,
    (
        "topic_delay_median_s",
        "s",
        (
            "Median delay from just before a sample is passed to the middleware until the subscriber receives it. "
            "Each delay and age of a topic is empty if topic_delay_error_s is unknown or above a tenth of it."
        ),
        Figure("topic delay", Kind.MEDIAN, rank=73, of_sent="topic_delay_median_sent_s"),
    ),
    ("topic_delay_mean_s", "s", "Mean delay of samples; empty as for topic_delay_median_s."),
    (
        "topic_delay_p95_s",
        "s",
        "95th percentile of the delay of samples; empty as for topic_delay_median_s.",
        Figure("topic delay, 95 %", Kind.MEDIAN, rank=74, of_sent="topic_delay_p95_sent_s"),
    ),
    ("topic_delay_max_s", "s", "Largest delay of a sample; empty as for topic_delay_median_s."),
    ("topic_delay_error_s", "s", "Maximum error of each delay that is caused by the clocks, from the captures."),
    (
        "topic_delay_variation_p95_s",
        "s",
        "95th percentile of the delay relative to the fastest sample, which needs no common clock (RFC 5481).",
        Figure("topic delay variation, 95 %", Kind.MEDIAN, rank=75),
    ),
    (
        "topic_jitter_s",
        "s",
        "Interarrival jitter of the samples, after the last one (RFC 3550, section 6.4.1).",
        Figure("topic's last jitter value (RFC 3550)", Kind.MEDIAN, rank=76),
    ),
    (
        "topic_age_mean_s",
        "s",
        "Age of information, mean from the first arrival to the last (Kaul, Yates and Gruteser 2012).",
        Figure("age of information", Kind.MEDIAN, rank=77),
    ),
    (
        "topic_age_peak_s",
        "s",
        "Mean age of information just before each newer sample arrived (Costa, Codreanu and Ephremides 2016).",
        Figure("peak age of information", Kind.MEDIAN, rank=78),
    ),
    (
        "topic_deadline_misses",
        "count",
        "Deadlines that passed between two arrivals without a sample, as in DDS. Empty without a deadline.",
        Figure("topic deadline misses", Kind.MEAN, rank=79),
    ),
)
_TRAFFIC: Final = columns(
    100,
    ("topic_data_packets", "count", "IP packets of the topic's data and its acknowledgements at the publisher."),
    (
        "topic_data_bytes",
        "B",
        "Bytes of topic_data_packets with the headers of their frames.",
        Figure("topic data bytes", Kind.MEAN, rank=80),
    ),
    (
        "topic_packet_loss",
        "share",
        (
            "Share of the IP packets of the topic's data from publisher to subscriber over UDP, each fragment "
            "separately, that are not in the subscriber's capture. Empty over TCP."
        ),
        Figure("topic packet loss", Kind.MEAN, rank=82),
    ),
    (
        "topic_discovery_packets",
        "count",
        "IP packets of discovery at the publisher.",
    ),
    (
        "topic_discovery_bytes",
        "B",
        "Bytes of topic_discovery_packets with the headers of their frames.",
        Figure("topic discovery bytes", Kind.MEAN, rank=81),
    ),
)

_OF_SENT: Final = columns(
    110,
    (
        "topic_delay_median_sent_s",
        "s",
        (
            "Median delay of all samples sent; a lost one counts as later than all others. Empty if half of "
            "them or more were lost, and if topic_delay_error_s is above a tenth of it."
        ),
    ),
    (
        "topic_delay_p95_sent_s",
        "s",
        (
            "95th percentile of the delay of all samples sent; a lost one counts as later than all others. Empty if "
            "about 5 % or more were lost."
        ),
    ),
)

_WITHHELD: Final = columns(
    120,
    (
        "topic_capture_withheld",
        "text",
        (
            "Reason why columns that depend on the captures are empty although the repeat is valid: packets were "
            "dropped before tcpdump. Samples, losses, delay variation and jitter are from the logs alone. Empty if "
            "no packet was dropped."
        ),
    ),
)

COLUMNS: Final = (*_COUNTS, *_TIMES, *_TRAFFIC, *_OF_SENT, *_WITHHELD)


@dataclass(frozen=True)
class TopicTraffic:
    """Properties that identify a topic's packets, and its deadline.

    Attributes:
        sender_address: Address of the publisher.
        receiver_address: Address of the subscriber.
        data_ports: Ports of samples and their acknowledgements.
        discovery_ports: Ports of discovery.
        deadline_s: Largest expected time between samples; None without a deadline.
    """

    sender_address: str
    receiver_address: str
    data_ports: frozenset[int]
    discovery_ports: frozenset[int]
    deadline_s: float | None


def measure(
    flow: TopicTraffic,
    publisher_log: TopicLog | None,
    subscriber_log: TopicLog | None,
    publisher_packets: Packets | None,
    subscriber_packets: Packets | None,
) -> Measured:
    """Return the measured columns of a topic.

    Args:
        flow: Addresses and ports that identify the packets of the topic.
        publisher_log: Log of the publisher; None if it is incomplete.
        subscriber_log: Log of the subscriber; None if it is incomplete.
        publisher_packets: Packets that the publisher's robot captured; None without a complete capture.
        subscriber_packets: Packets that the subscriber's robot captured; None without a complete capture.
    """
    traffic = _packet_loss(flow, publisher_packets, subscriber_packets) | _traffic(flow, publisher_packets)
    if publisher_log is None or subscriber_log is None:
        log_columns = (*_COUNTS, *_TIMES, *_OF_SENT)
        return traffic | Measured.all_missing(log_columns, "there are no complete logs of both ends")
    arrivals = first_arrivals(subscriber_log)
    clocks = None
    if publisher_packets is not None and subscriber_packets is not None:
        clocks = clocks_between(publisher_packets, subscriber_packets, flow.sender_address, flow.receiver_address)
    counts = _counts(publisher_log, arrivals, len(subscriber_log.samples))
    return traffic | counts | _times(arrivals, clocks, flow.deadline_s, len(publisher_log.samples))


def withheld_reasons(measured: Measured, reason: str) -> dict[str, str]:
    """Return the reason for each missing column of a topic that depends on the captures, if packets were dropped.

    Args:
        measured: Columns measured without the captures.
        reason: The reason why the captures are not used; empty if they are used.
    """
    if not reason:
        return {}
    clock_dependent = {column.name for column in (*_TIMES, *_OF_SENT)} - {"topic_deadline_misses"}
    names = clock_dependent | {column.name for column in _TRAFFIC}
    return {name: reason for name in sorted(names) if name not in measured.values}


def measure_withheld(reason: str) -> Measured:
    """Return the column `topic_capture_withheld`.

    Args:
        reason: The reason why the captures are not used; empty if they are used.
    """
    return Measured.from_optional({"topic_capture_withheld": reason or None}, "no packet was dropped before tcpdump")


def first_arrivals(log: TopicLog) -> TopicSamples:
    """Return the first arrival of each sample, in the order of the log."""
    _, first = np.unique(log.samples.sequence, return_index=True)
    return log.samples.where(np.sort(first))


def _counts(publisher_log: TopicLog, arrivals: TopicSamples, arrival_count: int) -> Measured:
    was_sent = np.isin(arrivals.sequence, publisher_log.samples.sequence)
    received_count, sent_count = int(was_sent.sum()), len(publisher_log.samples)
    discovery_s = None
    if publisher_log.discovery_start_ns is not None and publisher_log.matched_ns is not None:
        discovery_s = (publisher_log.matched_ns - publisher_log.discovery_start_ns) / 1e9
    values: dict[str, Value | None] = {
        "topic_sent": sent_count,
        "topic_received": received_count,
        "topic_loss": 1 - received_count / sent_count if sent_count else None,
        "topic_repeated": arrival_count - len(arrivals),
        "topic_refused": publisher_log.refused,
        "topic_skipped": publisher_log.skipped,
        "topic_discovered": publisher_log.matched_ns is not None,
        "topic_discovery_s": discovery_s,
    }
    return Measured.from_optional(values, "the publisher discovered no subscription, so nothing was sent")


def _times(arrivals: TopicSamples, clocks: Clocks | None, deadline_s: float | None, sent_count: int) -> Measured:
    """Return the columns of times; each sample is once in `arrivals`, in the order of arrival."""
    transit_ns = arrivals.at_ns - arrivals.sent_ns
    values: dict[str, Value | None] = {"topic_jitter_s": jitter_s(transit_ns)}
    if deadline_s is not None:
        values["topic_deadline_misses"] = deadline_misses(arrivals.at_ns, deadline_s)
    if len(arrivals):
        variation_s = (transit_ns - transit_ns.min()) / 1e9
        values["topic_delay_variation_p95_s"] = float(np.percentile(variation_s, 95))
    if len(arrivals) and clocks is not None and math.isfinite(clocks.error_s(arrivals.at_ns)):
        values |= _clock_dependent_values(arrivals, clocks, sent_count)
    reason = (
        "too few samples arrived, there is no deadline, or the clock offset from the captures is not accurate enough"
    )
    return Measured.from_optional(values, reason) | Measured.all_missing((*_TIMES, *_OF_SENT), reason)


def _clock_dependent_values(arrivals: TopicSamples, clocks: Clocks, sent_count: int) -> dict[str, float]:
    """Return the clock error, and the delays and ages for which it is small enough."""
    delay_s, error_s = clocks.delays_s(arrivals.sent_ns, arrivals.at_ns), clocks.error_s(arrivals.at_ns)
    mean_s, peak_s = age_s((arrivals.at_ns - arrivals.at_ns[0]) / 1e9, delay_s)
    figures = {
        "topic_delay_median_s": float(np.median(delay_s)),
        "topic_delay_mean_s": float(delay_s.mean()),
        "topic_delay_p95_s": float(np.percentile(delay_s, 95)),
        "topic_delay_max_s": float(delay_s.max()),
        "topic_age_mean_s": mean_s,
        "topic_age_peak_s": peak_s,
        "topic_delay_median_sent_s": quantile_of_sent(delay_s, sent_count, 0.5),
        "topic_delay_p95_sent_s": quantile_of_sent(delay_s, sent_count, 0.95),
    }
    accurate_figures = {
        name: value for name, value in figures.items() if value is not None and error_s <= LARGEST_ERROR * value
    }
    return {"topic_delay_error_s": error_s, **accurate_figures}


def age_s(at_s: Floats, delay_s: Floats) -> tuple[float | None, float | None]:
    """Return the mean age of information over time, and the mean of its peaks.

    Args:
        at_s: Time of arrival of each sample, ascending.
        delay_s: Age of the sample on arrival.

    Returns:
        The mean from the first arrival to the last, None if they are the same; the mean peak, None without a drop.
    """
    sent_s = at_s - delay_s
    newest_s = np.maximum.accumulate(sent_s)
    is_newer = np.concatenate(([True], sent_s[1:] > newest_s[:-1]))
    at_s, newest_s = at_s[is_newer], newest_s[is_newer]
    if len(at_s) < 2:
        return None, None
    # Between two arrivals the age increases linearly.
    peaks = at_s[1:] - newest_s[:-1]
    steps = np.diff(at_s)
    mean = float(((peaks - steps / 2) * steps).sum() / steps.sum()) if steps.sum() > 0 else None
    return mean, float(peaks.mean())


def deadline_misses(at_ns: Ints, deadline_s: float) -> int:
    """Return the number of missed deadlines: one per period without a sample (DDS 1.4, section 2.2.3)."""
    gaps_s = np.diff(at_ns) / 1e9
    # A sample that arrives exactly at its deadline is in time.
    return int(np.maximum(np.ceil(gaps_s / deadline_s - 1e-9) - 1, 0).sum())


def _traffic(flow: TopicTraffic, publisher_packets: Packets | None) -> Measured:
    """Return the counts of the topic's data and discovery packets in a capture."""
    if publisher_packets is None:
        return Measured.all_missing(_TRAFFIC, "there is no complete capture of the publisher")
    data, discovery = list(flow.data_ports), list(flow.discovery_ports)
    packets = with_ports(publisher_packets)
    to_data, to_discovery = np.isin(packets.dport, data), np.isin(packets.dport, discovery)
    from_data, from_discovery = np.isin(packets.sport, data), np.isin(packets.sport, discovery)
    # If the two ports of a packet are of different kinds, the destination port decides.
    kinds = {
        "data": to_data | (from_data & ~to_discovery),
        "discovery": to_discovery | (from_discovery & ~to_data),
    }
    values: dict[str, Value | None] = {}
    for name, mask in kinds.items():
        values[f"topic_{name}_packets"] = int(mask.sum())
        values[f"topic_{name}_bytes"] = int(publisher_packets.wire_bytes[mask].sum())
    return Measured.from_optional(values, "")


def _packet_loss(
    flow: TopicTraffic, publisher_packets: Packets | None, subscriber_packets: Packets | None
) -> Measured:
    """Return the share of UDP data packets from publisher to subscriber that did not arrive."""
    if publisher_packets is None or subscriber_packets is None:
        return Measured.from_optional({"topic_packet_loss": None}, "there are no complete captures of both ends")

    def forward(packets: Packets) -> Packets:
        ends = packets.are_from(flow.sender_address) & packets.are_to(flow.receiver_address)
        return packets.where(ends & (packets.protocol == UDP))

    sent_packets = forward(publisher_packets)
    # At the subscriber a first fragment, and with it the port, may be missing. The sender's capture has all ports.
    is_data = np.isin(with_ports(sent_packets).dport, list(flow.data_ports))
    has_arrived = match(sent_packets, forward(subscriber_packets)).arrived[is_data]
    loss = 1 - float(has_arrived.mean()) if len(has_arrived) else None
    return Measured.from_optional({"topic_packet_loss": loss}, "none of its data was sent over UDP")
