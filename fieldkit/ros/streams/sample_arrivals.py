"""Arrivals of samples: the times in a subscriber's log compared with the times in its capture.

A sample is found in a capture by its head, which contains its number and time of sending (`topic_samples`).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.core.units import format_count
from fieldkit.measure.captures.arrays import Floats, Ints, Mask
from fieldkit.ros.streams.topic_samples import SampleFlow, SampleHeads, TopicSamples

STAMP_NS: Final = 2_000
"""Tolerance of packet times: tcpdump truncates them to microseconds, and the kernel may read them 1 us too late."""
MAX_LATENCY_NS: Final = 5_000_000
MAX_LATENCY_FEW_NS: Final = 20_000_000
MIN_SAMPLES: Final = 20
"""Maximum time from a sample's packet to its record in the log, for the sample with the shortest such time. The
larger value is for fewer than `MIN_SAMPLES` samples. A program on a busy robot delays single samples for longer, but
not all of them."""
_MAX_RELEASE_WAIT_NS: Final = 600_000_000
"""If a sample is permanently lost, a reliable middleware may withhold the next samples for this time, until it
detects the loss."""


@dataclass(frozen=True, eq=False)
class SampleArrivals:
    """Samples in the subscriber's log that are also in its capture.

    Attributes:
        record_delay_ns: Time of the sample's record in the log minus time of the first packet with the sample's head.
        latency_s: Time of the record minus time of the packet that completed the sample, and all earlier ones if they
            are delivered in order. Samples that may have waited for a sample that was not captured are omitted. None
            if this packet is unknown for every sample.
    """

    record_delay_ns: Ints
    latency_s: Floats | None

    @classmethod
    def of(cls, samples: TopicSamples, subscriber: SampleFlow, *, complete: bool, reliable: bool) -> "SampleArrivals":
        """Return the arrivals.

        Args:
            samples: Samples in the log, each once.
            subscriber: The topic in the subscriber's capture.
            complete: Whether the subscriber's capture has all packets of the topic's data that were sent.
            reliable: Whether samples are retransmitted until they arrive.
        """
        heads = subscriber.heads.first()
        _, log_index, capture_index = np.intersect1d(samples.sequence, heads.sequence, return_indices=True)
        at_ns, head_ns = samples.at_ns[log_index], heads.at_ns[capture_index]
        complete_ns = _complete_ns(subscriber, heads, complete=complete, reliable=reliable) if len(heads) else None
        if complete_ns is None:
            return cls(at_ns - head_ns, None)
        latency_s = (at_ns - complete_ns[capture_index]) / 1e9
        return cls(
            at_ns - head_ns,
            latency_s[~_may_have_waited(samples, heads)] if reliable and not subscriber.is_tcp else latency_s,
        )

    def contradictions(self) -> Iterator[str]:
        """Yield contradictions between the times in the log and in the capture."""
        early_ns = -int(self.record_delay_ns.min(initial=0))
        if early_ns > STAMP_NS:
            early_count = int((self.record_delay_ns < -STAMP_NS).sum())
            early_text = f"{format_count(early_count, 'sample')} in the subscriber's log arrived up to"
            yield f"{early_text} {early_ns / 1e9:.6f} s earlier than the packets in its capture"
        if self.latency_s is not None and len(self.latency_s) > 2:
            min_latency_s = float(self.latency_s.min())
            if min_latency_s > (MAX_LATENCY_NS if len(self.latency_s) >= MIN_SAMPLES else MAX_LATENCY_FEW_NS) / 1e9:
                yield f"the subscriber's log is {min_latency_s:.6f} s or more later than its capture for every sample"


def _complete_ns(subscriber: SampleFlow, heads: SampleHeads, *, complete: bool, reliable: bool) -> Ints | None:
    """Return the times at which the samples of `heads` were completely received; None if they are unknown.

    Over TCP and with a reliable middleware, all earlier samples must have been received, too.
    """
    if subscriber.is_tcp:
        return _contiguous_ns(subscriber, heads.end)
    if heads.is_complete.all():
        delivered_ns: Ints = np.maximum.accumulate(heads.at_ns) if reliable else heads.at_ns
        return delivered_ns
    return _before_next_ns(subscriber, heads) if complete else None


def _may_have_waited(samples: TopicSamples, heads: SampleHeads) -> Mask:
    """Return a mask of the captured samples that may have waited for a sample that was not captured.

    Its elements are in the order of sample numbers.

    A reliable middleware delays samples until the previous one has arrived or is known to be lost.
    """
    numbers, first = np.unique(samples.sequence, return_index=True)
    at_ns = samples.at_ns[first]
    rank = np.minimum(np.searchsorted(heads.sequence, numbers), len(heads) - 1)
    is_captured = heads.sequence[rank] == numbers
    all_numbers = np.concatenate((numbers, heads.sequence))
    after_gap = (numbers > 0) & ~np.isin(numbers - 1, all_numbers)
    # Time until which later samples may have waited: for an uncaptured sample, until its record in the log; for a
    # captured sample after a gap, until its record, or until the middleware has detected the loss.
    released_ns = np.where(is_captured, 0, at_ns)
    released_ns[after_gap & is_captured] = np.minimum(at_ns, heads.at_ns[rank] + _MAX_RELEASE_WAIT_NS)[
        after_gap & is_captured
    ]
    released_ns = np.maximum.accumulate(released_ns)
    mask: Mask = (after_gap | (np.append(0, released_ns[:-1]) > heads.at_ns[rank]))[is_captured]
    return mask


def _contiguous_ns(subscriber: SampleFlow, end: Ints) -> Ints | None:
    """Return the times at which a TCP connection had delivered every byte before `end`; None if it is unknown."""
    if (connection := subscriber.connection()) is None:
        return None
    data, _ = connection
    base = int(end[0])
    starts, first = np.unique(seq_difference(data.tcp_seq, base), return_index=True)
    # TCP delivers the bytes of a segment when all segments before it have arrived, too.
    until_ns = np.maximum.accumulate(data.time_ns[first])
    contiguous_ns: Ints = until_ns[np.maximum(np.searchsorted(starts, seq_difference(end, base), side="left") - 1, 0)]
    return contiguous_ns


def seq_difference(number: Ints, base: int) -> Ints:
    """Return the signed difference of sequence numbers from `base`, modulo 2**32 (RFC 9293, section 3.4)."""
    return (number - base + (1 << 31)) % (1 << 32) - (1 << 31)


def _before_next_ns(subscriber: SampleFlow, heads: SampleHeads) -> Ints:
    """Return the time of the last packet before the next sample starts, for samples in several packets."""
    times_ns, head_ns = np.sort(subscriber.packets.time_ns), np.sort(heads.at_ns)
    next_index = np.searchsorted(head_ns, heads.at_ns, side="right")
    next_ns = np.append(head_ns, times_ns[-1] + 1)[next_index]
    last_ns: Ints = times_ns[np.maximum(np.searchsorted(times_ns, next_ns, side="left") - 1, 0)]
    return last_ns
