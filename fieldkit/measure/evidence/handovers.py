"""Handovers of a station between access points, and the time without answers to ping that each handover causes.

Handovers are detected in samples of the station's link. If the answers of ping have time stamps, only samples taken
while ping runs (plus or minus one interval) are used, because a robot may roam again while it is moved back to its
start. A handover happens between the last sample with the old access point and the first sample with the new one. The
gap of a handover is the longest time between two consecutive answers that overlaps this interval. Its resolution is
therefore the interval of the ping, not of the samples. The times of samples and answers must be from the clock of the
robot that roams.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from fieldkit.core.columns import Figure, Kind, Measured, Value, columns
from fieldkit.core.model import LinkSample
from fieldkit.measure.evidence import link
from fieldkit.measure.evidence.ping import Ping
from fieldkit.measure.evidence.ping_gaps import stamped_answers

COLUMNS: Final = columns(
    100,
    (
        "roam_ap_before",
        "text",
        "Access point of the robot at the start of the ping: its BSSID, or its name in a lab.",
    ),
    ("roam_ap_after", "text", "Access point of the robot at the end of the ping."),
    (
        "roam_handovers",
        "count",
        "Number of handovers to another access point during the ping.",
        Figure("handovers", Kind.MEDIAN),
    ),
    (
        "roam_ping_pongs",
        "count",
        "Handovers back to an access point within the time `ping_pong` of the step after the robot had left it.",
        Figure("ping-pong handovers", Kind.MEDIAN),
    ),
    (
        "roam_gap_s",
        "s",
        (
            "Longest time between consecutive answers around a handover; empty without a handover, if ping started "
            "or ended in this gap, and if the answers have no time stamps."
        ),
        Figure("longest gap of a handover", Kind.MEDIAN, at_least="roam_gap_at_least_s"),
    ),
    (
        "roam_gap_at_least_s",
        "s",
        "Lower bound of roam_gap_s if ping started or ended in a longer gap around a handover; otherwise empty.",
    ),
    (
        "roam_lost",
        "count",
        "Echo requests without an answer in the gaps around all handovers; empty without a handover.",
        Figure("lost in handovers", Kind.MEDIAN),
    ),
)

_NO_ACCESS_POINT: Final = "the robot's radio reported no access point: it is not a station, or was not sampled"
_NO_HANDOVER: Final = "there was no handover"
_NO_GAP: Final = "ping has no summary, or no answers with time stamps around a handover"


@dataclass(frozen=True)
class Handover:
    """A handover of a station from one access point to another.

    Attributes:
        old: Access point before the handover.
        new: Access point after the handover.
        left_ns: Time of the last sample with the old access point, nanoseconds since 1970 UTC.
        joined_ns: Time of the first sample with the new access point, nanoseconds since 1970 UTC.
    """

    old: str
    new: str
    left_ns: int
    joined_ns: int


@dataclass(frozen=True)
class HandoverGap:
    """The time without answers around a handover.

    Attributes:
        duration_s: Time in seconds between the answers before and after the gap. For an open gap, the number of
            requests without an answer times the interval.
        first_lost: Sequence number of the first request in the gap; it was answered if `lost` is 0.
        lost: Number of requests without an answer.
        is_open: True if ping started or ended in the gap.
    """

    duration_s: float
    first_lost: int
    lost: int
    is_open: bool


def find_handovers(samples: Sequence[LinkSample]) -> list[Handover]:
    """Return the handovers in the samples of a radio, which must be in the order of time.

    A new association with the same access point is not a handover.
    """
    return [
        Handover(old, new, left_ns, joined_ns)
        for (left_ns, old), (joined_ns, new) in pairwise(link.access_points(samples))
        if old != new
    ]


def count_ping_pongs(handovers: Sequence[Handover], within_s: float) -> int:
    """Return the number of handovers back to an access point within `within_s` after the handover away from it."""
    return sum(
        later.new == earlier.old and later.joined_ns - earlier.joined_ns <= within_s * 1e9
        for earlier, later in pairwise(handovers)
    )


def gap_around(handover: Handover, output: Ping, interval_s: float) -> HandoverGap | None:
    """Return the gap of a handover.

    None if ping was not running at that time, if its answers have no time stamps, or if it has no summary.

    Args:
        handover: The handover.
        output: Output of ping on the robot that roamed.
        interval_s: Time between two requests.
    """
    answers = sorted(stamped_answers(output))
    if not answers or output.transmitted is None:
        return None
    last_seq = output.first_seq + output.transmitted - 1
    (first_answered, first_ns), (last_answered, last_ns) = answers[0], answers[-1]
    gaps = [
        HandoverGap((next_ns - answer_ns) / 1e9, seq + 1, next_seq - seq - 1, is_open=False)
        for (seq, answer_ns), (next_seq, next_ns) in pairwise(answers)
        if answer_ns <= handover.joined_ns and next_ns >= handover.left_ns
    ]
    unanswered = first_answered - output.first_seq
    if unanswered > 0 and handover.left_ns <= first_ns:
        gaps.append(HandoverGap(unanswered * interval_s, output.first_seq, unanswered, is_open=True))
    unanswered = last_seq - last_answered
    if unanswered > 0 and handover.joined_ns >= last_ns:
        gaps.append(HandoverGap(unanswered * interval_s, last_answered + 1, unanswered, is_open=True))
    return max(gaps, key=lambda gap: gap.duration_s, default=None)


def measure(samples: Sequence[LinkSample], output: Ping | None, interval_s: float, ping_pong_s: float) -> Measured:
    """Return the columns of a robot that roams.

    Args:
        samples: Samples of its radio, in the order of time.
        output: Output of the ping that it sends; None if it is not available.
        interval_s: Time between two requests.
        ping_pong_s: Maximum time in seconds between the two handovers of a ping-pong.
    """
    start_ns, end_ns = _window_ns(output, interval_s)
    samples = [sample for sample in samples if start_ns <= sample.utc_ns <= end_ns]
    access_points = [access_point for _, access_point in link.access_points(samples)]
    if not access_points:
        return Measured.all_missing(COLUMNS, _NO_ACCESS_POINT)
    handovers = find_handovers(samples)
    values: dict[str, Value] = {
        "roam_ap_before": access_points[0],
        "roam_ap_after": access_points[-1],
        "roam_handovers": len(handovers),
        "roam_ping_pongs": count_ping_pongs(handovers, ping_pong_s),
    }
    return Measured(values) | _measure_gaps(handovers, output, interval_s)


def _window_ns(output: Ping | None, interval_s: float) -> tuple[float, float]:
    """Return start and end of a run of ping in ns.

    Minus and plus infinity if there is no output, or it has no answer with a time stamp or no summary.
    """
    answers = [] if output is None else sorted(stamped_answers(output))
    if output is None or not answers or output.transmitted is None:
        return -math.inf, math.inf
    (first_answered, first_ns), (last_answered, last_ns) = answers[0], answers[-1]
    before_s = (first_answered - output.first_seq + 1) * interval_s
    after_s = (output.first_seq + output.transmitted - last_answered) * interval_s
    return first_ns - before_s * 1e9, last_ns + after_s * 1e9


def _measure_gaps(handovers: Sequence[Handover], output: Ping | None, interval_s: float) -> Measured:
    """Return the columns of the gaps that the handovers caused."""
    candidates = [] if output is None else [gap_around(handover, output, interval_s) for handover in handovers]
    gaps = [gap for gap in candidates if gap is not None]
    if not gaps:
        reason = _NO_GAP if handovers else _NO_HANDOVER
        return Measured({}, dict.fromkeys(("roam_gap_s", "roam_gap_at_least_s", "roam_lost"), reason))
    longest = max(gaps, key=lambda gap: gap.duration_s)
    if longest.is_open:
        filled, empty, reason = "roam_gap_at_least_s", "roam_gap_s", "ping started or ended in the gap"
    else:
        filled, empty, reason = "roam_gap_s", "roam_gap_at_least_s", "ping neither started nor ended in the gap"
    # Two handovers may share a gap, whose requests are counted once.
    lost = sum({gap.first_lost: gap.lost for gap in gaps}.values())
    return Measured({filled: longest.duration_s, "roam_lost": lost}, {empty: reason})
