"""Contradictions between the reads of the newest sample and the arrivals of samples in the same log."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from fieldkit.core.crosschecks import CheckOutcome, CrossCheck
from fieldkit.core.units import format_count
from fieldkit.measure.captures.arrays import Ints
from fieldkit.ros.streams.topic_checks import MAX_SLEW_NS
from fieldkit.ros.streams.topic_samples import TopicLog

SEEN: Final = "a display of frames"
"""Exclusive resource of the steps that have the columns `seen_*`: a repeat has only one such step without a name."""
_MAX_READ_DELAY_NS: Final = 200_000_000
"""Maximum time from the arrival of a sample until a read returns it, on a busy robot."""


def check_reads(received: TopicLog) -> Iterator[str]:
    """Yield each contradiction between reads and arrivals in a subscriber's log as a sentence."""
    samples, reads = received.samples, received.reads
    order = np.argsort(samples.at_ns, kind="stable")
    arrival_ns = samples.at_ns[order]
    newest = np.append(-1, np.maximum.accumulate(samples.sequence[order]))

    def newest_at(at_ns: Ints) -> Ints:
        """Return the number of the newest sample that had arrived at each time; -1 if none had."""
        number: Ints = newest[np.searchsorted(arrival_ns, at_ns, side="right")]
        return number

    if early := int((reads.sequence > newest_at(reads.at_ns + MAX_SLEW_NS)).sum()):
        yield f"{format_count(early, 'read')} in the subscriber's log returned a sample before it arrived"
    if stale := int((reads.sequence < newest_at(reads.at_ns - _MAX_READ_DELAY_NS)).sum()):
        yield f"{format_count(stale, 'read')} in the subscriber's log did not return the newest sample"
    numbers, first = np.unique(samples.sequence, return_index=True)
    _, read_index, sample_index = np.intersect1d(reads.sequence, numbers, return_indices=True)
    if (reads.sent_ns[read_index] != samples.sent_ns[first][sample_index]).any():
        yield "a read in the subscriber's log has another time of sending than the sample"


def cross_checks(*prefixes: str, stream: str) -> tuple[CrossCheck, ...]:
    """Return the sources of the columns of reads, and the checks between them.

    Args:
        prefixes: Prefixes of the columns.
        stream: `topic`, or `video` for a stream over RTP.
    """
    sample, sender, receiver = (
        ("frame", "sender", "receiver") if stream == "video" else ("sample", "publisher", "subscriber")
    )
    log = f"`ROLE-{stream}.bin` of the {receiver}"

    def columns(*names: str) -> tuple[str, ...]:
        return tuple(f"{prefix}_{name}" for prefix in prefixes for name in names)

    return (
        CrossCheck(
            quantity=f"newest {sample} at each read of a {stream}",
            columns=columns("age_*", "withheld", "blank", "repeated", "distinct", "never", "gap*"),
            source=f"{log}: reads",
            against=(f"{log}: arrivals", f"the log of the {sender}: times of sending"),
            tolerance=(
                f"a {sample} may arrive up to 0.2 s before its first read on a busy robot; no read is before the "
                "arrival"
            ),
        ),
        CrossCheck(
            quantity=f"clock offset used for the age of a {sample} when it is read",
            columns=columns("age_*", "late"),
            source=f"{log}: reads and times of sending",
            against=("the captures: packets in both directions, which limit the clock offset",),
            tolerance="the clock error is at most a tenth of the age",
            outcome=CheckOutcome.WITHHELD,
        ),
        CrossCheck(
            quantity=f"number of reads of a {stream}",
            columns=columns("reads", "age_*", "gap*", "repeated", "blank"),
            source=f"{log}: reads",
            against=("the rate of reads in the procedure",),
            tolerance="at least 90 %: a busy robot misses single ticks",
            outcome=CheckOutcome.WITHHELD,
        ),
    )
