"""Longest time without an answer (an echo reply) in the output of ping."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from fieldkit.core.columns import Figure, Kind, Measured, columns
from fieldkit.measure.evidence.ping import Ping

GAP_COLUMNS: Final = columns(
    20,
    (
        "rtt_gap_s",
        "s",
        (
            "Longest time between consecutive replies; empty if ping printed no time stamps, or if the time without "
            "a reply at the start or end of ping was at least as long, or at least 1 s."
        ),
        Figure("longest gap between answers", Kind.MEDIAN, at_least="rtt_gap_at_least_s"),
    ),
    (
        "rtt_gap_lost",
        "count",
        "Echo requests without a reply during rtt_gap_s; empty if rtt_gap_s is empty.",
        Figure("lost in the gap", Kind.MEDIAN, at_least="rtt_gap_lost_at_least"),
    ),
)
OPEN_GAP_COLUMNS: Final = columns(
    110,
    (
        "rtt_gap_at_least_s",
        "s",
        (
            "Lower bound of rtt_gap_s if ping started or ended in the gap: the longest observed time without a "
            "reply. Empty otherwise."
        ),
    ),
    ("rtt_gap_lost_at_least", "count", "Lower bound of rtt_gap_lost if ping started or ended in the gap."),
)
_SEQUENCE_NUMBERS: Final = 1 << 16
"""Number of ICMP sequence numbers."""
_MAX_LATE_NUMBERS: Final = 1 << 10
"""An answer is late if its number is below the previous number by less than this; otherwise the numbers wrapped."""

MIN_OPEN_GAP_S: Final = 1.0
"""A gap at the start or end of a ping is ignored if it is shorter than this and than the longest other gap."""


@dataclass(frozen=True)
class AnswerGap:
    """The longest time without an answer in a run of ping.

    Attributes:
        duration_s: Time in seconds between the answers before and after the gap. If the gap is open: the observed
            part of this time or, if it is longer, the longest time between two answers.
        lost: Number of unanswered requests in the gap; for an open gap, the larger of the two numbers.
        is_open: True if ping started or ended in the gap, so that both numbers are lower bounds.
    """

    duration_s: float
    lost: int
    is_open: bool


def longest_gap(output: Ping, interval_s: float) -> AnswerGap | None:
    """Return the longest time between two answers with no answered request between them.

    A gap in which ping started or ended is open. It is returned if it is at least as long as the longest gap between
    two answers, or at least `MIN_OPEN_GAP_S` long. Return None if too few answers have a time stamp.

    Args:
        output: Output of ping.
        interval_s: Time between two requests. The observed part of an open gap is this interval times the number of
            unanswered requests.
    """
    stamped = sorted(stamped_answers(output))
    if not stamped and (output.answers or not output.transmitted):
        return None
    closed_gaps = [
        (next_ns - answer_ns, next_seq - seq - 1) for (seq, answer_ns), (next_seq, next_ns) in pairwise(stamped)
    ]
    gap_ns, lost = max(closed_gaps, default=(0, 0))
    unanswered = _open_gap_requests(output, [seq for seq, _ in stamped])
    open_s = unanswered * interval_s
    if unanswered and (unanswered >= lost or open_s >= MIN_OPEN_GAP_S):
        return AnswerGap(max(open_s, gap_ns / 1e9), max(unanswered, lost), is_open=True)
    return AnswerGap(gap_ns / 1e9, lost, is_open=False) if closed_gaps else None


def stamped_answers(output: Ping) -> Iterator[tuple[int, int]]:
    """Yield the sequence number and the time stamp of each answer that has a time stamp.

    The numbers are unwrapped: after 65,535, they continue with 65,536.
    """
    previous: int | None = None
    for answer in output.answers:
        if answer.at_utc_ns is not None:
            difference = (
                0
                if previous is None
                else (answer.seq - previous + _MAX_LATE_NUMBERS) % _SEQUENCE_NUMBERS - _MAX_LATE_NUMBERS
            )
            previous = answer.seq if previous is None else previous + difference
            yield previous, answer.at_utc_ns


def _open_gap_requests(output: Ping, answered_seqs: Sequence[int]) -> int:
    """Return the number of unanswered requests before the first answer or after the last one, whichever is larger."""
    sent = output.transmitted or 0
    if not answered_seqs:
        return sent
    return max(answered_seqs[0] - output.first_seq, output.first_seq + sent - 1 - answered_seqs[-1], 0)


def measure_gap(output: Ping | None, interval_s: float) -> Measured:
    """Return the columns of the longest gap between answers.

    Args:
        output: Output of ping; None if it is not available.
        interval_s: Time between two requests.
    """
    gap = None if output is None else longest_gap(output, interval_s)
    if gap is None:
        return Measured.all_missing((*GAP_COLUMNS, *OPEN_GAP_COLUMNS), "no two answers have a time stamp")
    closed_names, open_names = (
        tuple(column.name for column in columns) for columns in (GAP_COLUMNS, OPEN_GAP_COLUMNS)
    )
    filled, empty = (open_names, closed_names) if gap.is_open else (closed_names, open_names)
    reason = "ping started or ended in the gap" if gap.is_open else "ping neither started nor ended in the gap"
    values = dict(zip(filled, (gap.duration_s, gap.lost), strict=True))
    return Measured(values, dict.fromkeys(empty, reason))
