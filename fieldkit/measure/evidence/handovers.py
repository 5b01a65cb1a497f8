"""Handovers of a station between access points, from samples of its link, and the gaps that they cause in a ping.

Only samples during the ping count, because a robot may roam again while it is brought back to its place. A handover
happens between the last sample with the old access point and the first one with the new. The gap of a handover is the
longest time between two consecutive answers that overlaps this interval, so its resolution is the interval of the
ping, not of the samples. Both must have the clock of the robot that roams.
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
        "Number of times that the robot changed its access point during the ping.",
        Figure("handovers", Kind.MEDIAN),
    ),
    (
        "roam_ping_pongs",
        "count",
        "Handovers back to the access point that the robot had left less than the time `ping_pong` before.",
        Figure("ping-pong handovers", Kind.MEDIAN),
    ),
    (
        "roam_gap_s",
        "s",
        (
            "Longest time between consecutive answers around a handover; empty without a handover, and if ping "
            "started or ended in it."
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

_NO_ACCESS_POINT: Final = "its radio reported no access point: it is not a station, or was not sampled"
_NO_HANDOVER: Final = "there was no handover"
_NO_STAMPS: Final = "no two answers of ping have a time stamp"


@dataclass(frozen=True)
class Handover:
    """A change of access point.

    Attributes:
        before: Access point before it.
        after: Access point after it.
        left_ns: Time of the last sample with the access point before it, nanoseconds since 1970 UTC.
        joined_ns: Time of the first sample with the access point after it.
    """

    before: str
    after: str
    left_ns: int
    joined_ns: int


@dataclass(frozen=True)
class HandoverGap:
    """The time without answers around a handover.

    Attributes:
        duration_s: Time between the answers before and after it; the observed time if it is open.
        first_lost: First sequence number without an answer in it.
        lost: Number of requests without an answer in it.
        is_open: True if ping started or ended in it.
    """

    duration_s: float
    first_lost: int
    lost: int
    is_open: bool


def find_handovers(samples: Sequence[LinkSample]) -> list[Handover]:
    """Return the handovers in the samples of a radio, which are in the order of time.

    A new association with the same access point is not a handover.
    """
    return [
        Handover(before, after, left_ns, joined_ns)
        for (left_ns, before), (joined_ns, after) in pairwise(link.access_points(samples))
        if before != after
    ]


def count_ping_pongs(handovers: Sequence[Handover], within_s: float) -> int:
    """Return the number of handovers back to an access point that was left at most `within_s` before."""
    return sum(
        later.after == earlier.before and later.joined_ns - earlier.joined_ns <= within_s * 1e9
        for earlier, later in pairwise(handovers)
    )


def gap_around(handover: Handover, output: Ping, interval_s: float) -> HandoverGap | None:
    """Return the gap of a handover; None if ping was not running, or its answers have no time stamps.

    Args:
        handover: The handover.
        output: Output of ping on the robot that roamed.
        interval_s: Time between two requests.
    """
    answers = sorted(stamped_answers(output))
    if not answers or output.transmitted is None:
        return None
    last_seq = output.first_seq + output.transmitted - 1
    (first, first_ns), (last, last_ns) = answers[0], answers[-1]
    gaps = [
        HandoverGap((later_ns - ns) / 1e9, seq + 1, later - seq - 1, is_open=False)
        for (seq, ns), (later, later_ns) in pairwise(answers)
        if ns <= handover.joined_ns and later_ns >= handover.left_ns
    ]
    unanswered = first - output.first_seq
    if unanswered > 0 and handover.left_ns <= first_ns:
        gaps.append(HandoverGap(unanswered * interval_s, output.first_seq, unanswered, is_open=True))
    unanswered = last_seq - last
    if unanswered > 0 and handover.joined_ns >= last_ns:
        gaps.append(HandoverGap(unanswered * interval_s, last + 1, unanswered, is_open=True))
    return max(gaps, key=lambda gap: gap.duration_s, default=None)


def measure(samples: Sequence[LinkSample], output: Ping | None, interval_s: float, ping_pong_s: float) -> Measured:
    """Return the columns of a robot that roams.

    Args:
        samples: Samples of its radio, in the order of time.
        output: Output of the ping that it sends; None if it is not available.
        interval_s: Time between two requests.
        ping_pong_s: A handover back within this time is a ping-pong handover.
    """
    start_ns, end_ns = _window_ns(output, interval_s)
    samples = [sample for sample in samples if start_ns <= sample.utc_ns <= end_ns]
    cells = [access_point for _, access_point in link.access_points(samples)]
    if not cells:
        return Measured.all_missing(COLUMNS, _NO_ACCESS_POINT)
    handovers = find_handovers(samples)
    values: dict[str, Value] = {
        "roam_ap_before": cells[0],
        "roam_ap_after": cells[-1],
        "roam_handovers": len(handovers),
        "roam_ping_pongs": count_ping_pongs(handovers, ping_pong_s),
    }
    return Measured(values) | _measure_gaps(handovers, output, interval_s)


def _window_ns(output: Ping | None, interval_s: float) -> tuple[float, float]:
    """Return start and end of a run of ping; all times if its answers have no time stamps."""
    answers = [] if output is None else sorted(stamped_answers(output))
    if output is None or not answers or output.transmitted is None:
        return -math.inf, math.inf
    (first, first_ns), (last, last_ns) = answers[0], answers[-1]
    before_s = (first - output.first_seq + 1) * interval_s
    after_s = (output.first_seq + output.transmitted - last) * interval_s
    return first_ns - before_s * 1e9, last_ns + after_s * 1e9


def _measure_gaps(handovers: Sequence[Handover], output: Ping | None, interval_s: float) -> Measured:
    found = [] if output is None else [gap_around(handover, output, interval_s) for handover in handovers]
    gaps = [gap for gap in found if gap is not None]
    if not gaps:
        reason = _NO_STAMPS if handovers else _NO_HANDOVER
        return Measured({}, dict.fromkeys(("roam_gap_s", "roam_gap_at_least_s", "roam_lost"), reason))
    longest = max(gaps, key=lambda gap: gap.duration_s)
    filled, empty = ("roam_gap_s", "roam_gap_at_least_s")[:: -1 if longest.is_open else 1]
    reason = f"ping {'started or ended' if longest.is_open else 'neither started nor ended'} in the gap"
    # Two handovers may share a gap, whose requests are counted once.
    lost = sum({gap.first_lost: gap.lost for gap in gaps}.values())
    return Measured({filled: longest.duration_s, "roam_lost": lost}, {empty: reason})
