"""Age of the newest sample when a program reads it, for example the control loop of a robot, or a video display.

The age is the age of information (Kaul, Yates and Gruteser, "Real-time status: how often should one update?", INFOCOM
2012), sampled at the reads. With a constant delay D and a sending interval T its mean is D + T/2, and its 95th
percentile is D + 0.95 T, if the reads are not synchronized with the samples.

Reads and gaps are counted while samples are expected at the subscriber: from the time of sending of the first sample
until one interval after the last one, both shifted by the smallest difference between a sample's times of arrival and
sending. This needs no common clock.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.columns import Column, Figure, Kind, Measured, Value, columns
from fieldkit.core.units import format_count
from fieldkit.measure.captures.arrays import Floats
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.evidence.delay_quantiles import quantile_of_sent
from fieldkit.measure.transfers.clock_offset import Clocks
from fieldkit.measure.transfers.delay import LARGEST_ERROR, clocks_between
from fieldkit.ros.streams.topic_columns import first_arrivals
from fieldkit.ros.streams.topic_samples import SampleReads, TopicLog, TopicSamples

RANK: Final = 130
"""Position of the columns in trial.csv: after the columns of earlier versions."""
MIN_READS: Final = 0.9
"""If a program read less often than this share of the planned reads, columns that need each read are empty."""
_TAIL_QUANTILE: Final = 0.95
"""Quantile of the ages in the column `age_p95_s`."""


@dataclass(frozen=True)
class ReadPlan:
    """Settings of a stream whose newest sample is read.

    Attributes:
        prefix: Prefix of the columns: `seen` for frames, `used` for other samples.
        rate_hz: Planned reads per second.
        limit_s: Maximum age: an older sample is late, and a longer time without a newer sample is a gap.
        interval_s: Sending interval.
    """

    prefix: str
    rate_hz: float
    limit_s: float
    interval_s: float


def declare_columns(prefix: str, sent: str) -> tuple[Column, ...]:
    """Return the columns of reads.

    Args:
        prefix: Prefix of the columns; see `ReadPlan.prefix`.
        sent: Column with the number of samples that were sent.
    """
    item, items_text = ("frame", "displayed frames") if prefix == "seen" else ("sample", "used samples")
    empty = f"Empty if {prefix}_withheld has the reason."
    return columns(
        RANK,
        (
            f"{prefix}_age_p95_s",
            "s",
            (
                f"95th percentile, over the reads, of the age of the newest {item}: time of the read minus time of "
                f"sending. A read before the first {item} counts as older than all others. {empty}"
            ),
            Figure(f"age of {items_text}, 95 %", Kind.MEDIAN, rank=88),
        ),
        (
            f"{prefix}_age_mean_s",
            "s",
            f"Mean age over the reads from the first {item} on (age of information, Kaul et al. 2012). {empty}",
            Figure(f"age of {items_text}, mean", Kind.MEDIAN, rank=89),
        ),
        (
            f"{prefix}_age_max_s",
            "s",
            f"Largest age at a read. {empty}",
            Figure(f"age of {items_text}, largest", Kind.MEDIAN, rank=90),
        ),
        (f"{prefix}_age_error_s", "s", "Maximum error of each age that is caused by the clocks."),
        (f"{prefix}_withheld", "text", "Reason why ages are empty; empty if all of them have a value."),
        (f"{prefix}_reads", "count", f"Number of reads while {item}s were expected."),
        (f"{prefix}_blank", "share", f"Share of {prefix}_reads before the first {item}."),
        (
            f"{prefix}_repeated",
            "share",
            f"Share of {prefix}_reads that returned the same {item} as the previous read.",
            Figure(f"{item}s repeated", Kind.MEAN, rank=94),
        ),
        (f"{prefix}_distinct", "count", f"{item.capitalize()}s that at least one read returned."),
        (
            f"{prefix}_never",
            "share",
            f"1 - {prefix}_distinct/{sent}: {item}s that no read returned, whether lost or replaced by a newer one.",
            Figure(f"{item}s never {prefix}", Kind.COUNTED, f"{prefix}_distinct", sent, rank=91),
        ),
        (
            f"{prefix}_late",
            "share",
            (
                f"Share of the {item}s received that arrived after a newer one, or with an age above the limit of "
                "the step. Empty if the clock error is above a tenth of the limit."
            ),
            Figure(f"{item}s late", Kind.MEAN, rank=93),
        ),
        (
            f"{prefix}_gap_s",
            "s",
            f"Longest time in which reads returned no newer {item} although {item}s were expected.",
            Figure(f"longest time without a new {item}", Kind.MEDIAN, rank=92),
        ),
        (
            f"{prefix}_gaps",
            "count",
            f"Number of times without a newer {item} that were longer than the limit of the step.",
        ),
    )


def measure(
    plan: ReadPlan, sent: TopicLog | None, received: TopicLog | None, clocks: Clocks | None, unknown_clocks: str
) -> Measured:
    """Return the columns of reads.

    Args:
        plan: Settings of the stream.
        sent: Log of the publisher; None if it is incomplete.
        received: Log of the subscriber; None if it is incomplete.
        clocks: Offset of the subscriber's clock from the publisher's; None if it is unknown.
        unknown_clocks: Reason why it is unknown; ignored if it is known.
    """
    names = [column.name.removeprefix(f"{plan.prefix}_") for column in declare_columns(plan.prefix, "")]
    if sent is None or received is None:
        return _named(plan, {"withheld": "there are no complete logs of both ends"}, names)
    arrived = first_arrivals(received)
    arrived = arrived.where(np.isin(arrived.sequence, sent.samples.sequence))
    sent_count = len(sent.samples)
    distinct = len(np.intersect1d(received.reads.sequence, sent.samples.sequence))
    values: dict[str, Value | None] = {
        "distinct": distinct,
        "never": 1 - distinct / sent_count if sent_count else None,
    }
    if not len(arrived):
        return _named(plan, values | {"withheld": "no sample arrived"}, names)
    window = _expected_window(sent.samples, arrived, plan.interval_s)
    is_expected = (received.reads.at_ns >= window[0]) & (received.reads.at_ns < window[1])
    reads = received.reads.where(is_expected)
    is_repeated = np.append(False, np.diff(received.reads.sequence) == 0)[is_expected] & (reads.sequence >= 0)
    values["reads"] = len(reads)
    planned = int((window[1] - window[0]) / 1e9 * plan.rate_hz)
    if len(reads) < MIN_READS * planned:
        reason = f"the program read {format_count(len(reads), 'time')} instead of {planned}: the robot was busy"
        return _named(plan, values | {"withheld": reason}, names)
    gaps_s = _gaps_s(reads, window)
    values |= {
        "blank": float((reads.sequence < 0).mean()),
        "repeated": float(is_repeated.mean()),
        "gap_s": float(gaps_s.max()),
        "gaps": int((gaps_s > plan.limit_s).sum()),
    }
    values |= _ages(reads, clocks, unknown_clocks) | {"late": _late(arrived, clocks, plan.limit_s)}
    return _named(plan, values, names)


def find_clocks(
    sender: Packets | None, receiver: Packets | None, sender_address: str, receiver_address: str
) -> tuple[Clocks | None, str]:
    """Return the clock offset of two robots for `measure`, or None, and the reason that applies if it is None.

    Args:
        sender: Packets that the publisher's robot captured; None without a complete capture.
        receiver: Packets that the subscriber's robot captured; None without a complete capture.
        sender_address: Address of the publisher.
        receiver_address: Address of the subscriber.
    """
    if sender is None or receiver is None:
        return None, "there are no complete captures of both ends, which give the clock offset"
    clocks = clocks_between(sender, receiver, sender_address, receiver_address)
    return clocks, "the captures give no clock offset: they need several packets in both directions"


def _named(plan: ReadPlan, values: Mapping[str, Value | None], names: list[str]) -> Measured:
    """Return the columns with the prefix of `plan`; columns in `names` without a value are missing."""
    withheld = values.get("withheld")
    all_values = {f"{plan.prefix}_{name}": values.get(name) for name in names}
    return Measured.from_optional(all_values, str(withheld) if withheld else "nothing is withheld")


def _expected_window(sent: TopicSamples, arrived: TopicSamples, interval_s: float) -> tuple[int, int]:
    """Return the start and the end of the time in which the subscriber expects the stream, by its clock."""
    shift_ns = int((arrived.at_ns - arrived.sent_ns).min())
    return int(sent.sent_ns.min()) + shift_ns, int(sent.sent_ns.max()) + shift_ns + round(1e9 * interval_s)


def _gaps_s(reads: SampleReads, window: tuple[int, int]) -> Floats:
    """Return the times between consecutive reads that returned a newer sample.

    The first time is from the start of `window`, and the last is to its end.
    """
    is_newer = reads.sequence > np.maximum.accumulate(np.append(-1, reads.sequence[:-1]))
    gaps_s: Floats = np.diff(np.concatenate(([window[0]], reads.at_ns[is_newer], [window[1]]))) / 1e9
    return gaps_s


def _ages(reads: SampleReads, clocks: Clocks | None, unknown_clocks: str) -> dict[str, Value | None]:
    """Return the ages whose clock error is small enough, this error, and the reason why other ages are withheld."""
    sample_reads = reads.where(reads.sequence >= 0)
    if not len(sample_reads):
        return {"withheld": "no sample arrived before a read"}
    if clocks is None or not math.isfinite(error_s := clocks.error_s(sample_reads.at_ns)):
        return {"withheld": unknown_clocks}
    age_s = clocks.delays_s(sample_reads.sent_ns, sample_reads.at_ns)
    ages = {
        "age_p95_s": quantile_of_sent(age_s, len(reads), _TAIL_QUANTILE),
        "age_mean_s": float(age_s.mean()),
        "age_max_s": float(age_s.max()),
    }
    accurate_ages = {name: age for name, age in ages.items() if age is not None and error_s <= LARGEST_ERROR * age}
    reasons = []
    if ages["age_p95_s"] is None:
        reasons.append("5 % or more of the reads were before the first sample")
    if any(age is not None and name not in accurate_ages for name, age in ages.items()):
        reasons.append("the clock error is above a tenth of an age")
    return {"age_error_s": error_s, "withheld": " and ".join(reasons) or None, **accurate_ages}


def _late(arrived: TopicSamples, clocks: Clocks | None, limit_s: float) -> float | None:
    """Return the share of the samples that arrived too late; None if the clocks are not accurate enough."""
    if clocks is None or not clocks.error_s(arrived.at_ns) <= LARGEST_ERROR * limit_s:
        return None
    is_overtaken = arrived.sequence < np.maximum.accumulate(arrived.sequence)
    return float((is_overtaken | (clocks.delays_s(arrived.sent_ns, arrived.at_ns) > limit_s)).mean())
