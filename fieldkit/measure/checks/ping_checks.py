"""Contradictions within the output of ping, and between the output and captures.

On a busy machine with 2 cores, a round-trip time printed by iputils' ping minus the captured time was between -0.03
and 0.9 ms. The median of these differences was below 0.1 ms. iputils reads the arrival time of a reply from the
kernel. busybox reads the clock when its process resumes.

The capture has the time at which a request leaves the kernel. While the link-layer address of the next hop is unknown
(ARP, RFC 826), a request waits in the kernel: in Linux for up to 3 s (`mcast_solicit` in arp(7)). The printed time of
such a request, often the first one, contains this wait.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from statistics import median, median_low
from typing import Final

import numpy as np

from fieldkit.core.crosschecks import CrossCheck
from fieldkit.core.units import format_count
from fieldkit.measure.captures.arrays import Ints
from fieldkit.measure.captures.packets import ECHO_REPLY, NO_ECHO, Packets
from fieldkit.measure.evidence.ping import Ping, Reply

ICMP_HEADER_BYTES: Final = 8


@dataclass(frozen=True)
class CapturedPing:
    """Echoes of one ICMP identifier in one capture; times in nanoseconds since 1970 UTC, by sequence number.

    Attributes:
        requested_ns: Time of the first request; time of its first fragment if it is fragmented.
        replied_ns: Time of the first complete reply; time of its last fragment if it is fragmented.
    """

    requested_ns: Mapping[int, int]
    replied_ns: Mapping[int, int]


def captured_pings(packets: Packets, source: str, destination: str, payload_bytes: int) -> Iterator[CapturedPing]:
    """Yield the echoes of each identifier that has a request.

    Args:
        packets: A capture.
        source: Source address of the requests.
        destination: Destination address of the requests.
        payload_bytes: Payload of a request; echoes of another size belong to another ping.
    """
    outgoing, returning = packets.icmp(source, destination), packets.icmp(destination, source)
    requests = outgoing.where((outgoing.echo != NO_ECHO) & (outgoing.echo < ECHO_REPLY))
    requests = requests.where(_sizes(outgoing, requests) == payload_bytes + ICMP_HEADER_BYTES)
    replies = returning.where(returning.echo >= ECHO_REPLY)
    complete_ns = _complete_ns(returning, replies, payload_bytes + ICMP_HEADER_BYTES)
    for identifier in np.unique(requests.echo).tolist():
        matches = requests.echo == identifier
        is_answer = (replies.echo == identifier + ECHO_REPLY) & (complete_ns >= 0)
        yield CapturedPing(
            _earliest_by_number(requests.echo_seq[matches], requests.time_ns[matches]),
            _earliest_by_number(replies.echo_seq[is_answer], complete_ns[is_answer]),
        )


def _sizes(packets: Packets, first: Packets) -> Ints:
    """Return the captured size of each datagram, given its first fragment."""
    ends = packets.fragment_offset + packets.ip_payload_bytes
    order = np.lexsort((ends, packets.ip_id))
    ids, last = packets.ip_id[order], ends[order]
    unfragmented = ~first.more_fragments
    # Fragments with equal ids are sorted by their end, so the last of them has the largest end.
    at = np.searchsorted(ids, first.ip_id, side="right") - 1
    return np.where(unfragmented, first.ip_payload_bytes, last[at])


def _complete_ns(packets: Packets, first: Packets, size_bytes: int) -> Ints:
    """Return the time at which each datagram was complete; -1 if it was never complete, or has another size.

    Args:
        packets: All packets of this direction.
        first: First fragment of each datagram.
        size_bytes: IP payload of a complete datagram.
    """
    times_ns = np.where(first.more_fragments, -1, np.where(first.ip_payload_bytes == size_bytes, first.time_ns, -1))
    for index in np.flatnonzero(first.more_fragments):
        parts = packets.where(packets.ip_id == first.ip_id[index])
        _, unique_parts = np.unique(parts.fragment_offset, return_index=True)
        if int(parts.ip_payload_bytes[unique_parts].sum()) == size_bytes:
            times_ns[index] = parts.time_ns[unique_parts].max()
    return times_ns


def _earliest_by_number(numbers: Ints, times_ns: Ints) -> dict[int, int]:
    """Return the earliest time of each sequence number."""
    # The latest times are first, because a dictionary keeps the last value of a key.
    order = np.argsort(-times_ns, kind="stable")
    return dict(zip(numbers[order].tolist(), times_ns[order].tolist(), strict=True))


_ROUNDING: Final = 0.006
"""Relative rounding error of a round-trip time: ping prints three digits."""
_MAX_EARLIER_S: Final = 0.000_2
"""Maximum of a captured time minus the printed time."""
_MAX_MEDIAN_LATER_S: Final = 0.001
"""Maximum low median of the differences between printed and captured round-trip times, if there are several."""
_BUSYBOX_FACTOR: Final = 5
"""Factor by which the limits are larger for busybox's ping, which may print later."""
_MAX_PRINT_DELAY_S: Final = 1.0
"""Maximum of the time stamp of a printed line minus the captured time of the reply."""
_MAX_MEDIAN_PRINT_DELAY_S: Final = 0.05
"""Maximum median of the differences between time stamps of printed lines and captured times of the replies."""
_MAX_SEQUENCE: Final = 0xFFFF
"""Largest ICMP sequence number; the numbers of a longer ping wrap."""
_WAIT_SHARE: Final = 0.9
"""Minimum share of the interval that ping waits after its last request; below 1, because a timer may fire early."""
_UNREAD_S: Final = 0.1
"""ping may exit without reading a reply that arrived less than this time before its exit."""
_CLOCK_SLACK_S: Final = 1.0
"""Tolerance for time stamps before the first or after the last reading of the robot's clock."""

CROSS_CHECKS: Final = (
    CrossCheck(
        quantity="requests and replies",
        columns=("rtt_sent", "rtt_received", "rtt_loss", "rtt_gap_lost*"),
        source="`ping.txt`: reply lines and summary",
        against=(
            "the procedure: count",
            "each capture: echoes by sequence number",
            "the same file: summary and lines",
        ),
        tolerance=(
            "ping may not count a reply that arrives in its last 0.1 s, or later than one interval after the last "
            "request"
        ),
    ),
    CrossCheck(
        quantity="round-trip time of each reply",
        columns=("rtt_*_s", "paper_delay_s", "paper_transfer_s"),
        source="`ping.txt`: `time=`",
        against=("sender's capture: request to complete reply", "the same file: min/avg/max"),
        tolerance=(
            "0.6 %, because ping prints 3 digits, plus 1 ms for the median (5 times as much for busybox), because a "
            "busy robot delays ping; a single request may wait in the kernel, for example for ARP, but ping sends "
            "requests in order"
        ),
    ),
    CrossCheck(
        quantity="time of each reply",
        columns=("rtt_gap_s", "rtt_gap_at_least_s", "rtt_distance_*", "rtt_*_speed_m_s"),
        source="`ping.txt`: time stamps in brackets",
        against=("sender's capture: time of the reply", "the robot's clock before and after"),
        tolerance=(
            "1 s for one reply, 50 ms for the median, because the time stamp is the time at which ping prints the "
            "line"
        ),
    ),
    CrossCheck(
        quantity="payload of a request",
        columns=("rtt_payload_bytes", "paper_window_bytes"),
        source="`ping.txt`: first line",
        against=("the procedure", "each capture: size of echoes"),
        tolerance="none",
    ),
    CrossCheck(
        quantity="requests and copies over several links",
        columns=("rtt_duplicates", "rtt_over_*"),
        source="captures on all interfaces: interface of each echo",
        against=(
            "`ping.txt`: replies with `(DUP!)`",
            "receiver's capture: at most one reply per received request, and each answered request",
        ),
        tolerance=(
            "ping may not count a copy that arrives in its last 0.1 s, or later than one interval after the last "
            "request; fragmented requests are not compared"
        ),
    ),
)


def check_output(output: Ping, count: int, payload_bytes: int, window: tuple[int, int] | None) -> Iterator[str]:
    """Yield the contradictions within the output and its differences from the procedure.

    Args:
        output: Parsed output of ping.
        count: Number of requests in the procedure.
        payload_bytes: Payload of a request in the procedure.
        window: Readings of the robot's clock before and after the attempt, nanoseconds since 1970 UTC; None if
            unknown.
    """
    if output.transmitted is not None and output.transmitted > count:
        yield f"ping sent {output.transmitted} requests instead of {count}"
    if output.payload_bytes is not None and output.payload_bytes != payload_bytes:
        yield f"ping sent {output.payload_bytes} bytes instead of {payload_bytes}"
    last = None if output.transmitted is None else output.first_seq + output.transmitted - 1
    unexpected = [
        reply.seq for reply in output.replies if last is not None and not output.first_seq <= reply.seq <= last
    ]
    if unexpected and last is not None and last <= _MAX_SEQUENCE:
        yield f"ping printed a reply to request {unexpected[0]}, but its last request was {last}"
    yield from _check_summary(output)
    times_ns = [reply.at_utc_ns for reply in output.replies if reply.at_utc_ns is not None]
    if window is not None and times_ns:
        slack_ns = round(1e9 * _CLOCK_SLACK_S)
        if min(times_ns) < window[0] - slack_ns or max(times_ns) > window[1] + slack_ns:
            yield "ping has a reply from before or after the attempt according to the robot's clock"


def _check_summary(output: Ping) -> Iterator[str]:
    """Yield a contradiction for each time in ping's summary that differs from its reply lines."""
    times_s = [reply.rtt_s for reply in output.replies if reply.rtt_s is not None and not reply.damaged]
    if output.summary_s is None or not times_s:
        return
    line_times_s = min(times_s), sum(times_s) / len(times_s), max(times_s)
    for name, summary_s, printed_s in zip(
        ("shortest", "mean", "longest"), output.summary_s, line_times_s, strict=True
    ):
        # The summary has microseconds, so that each time may also differ by 2 us.
        if abs(summary_s - printed_s) > _ROUNDING * max(summary_s, printed_s) + 2e-6:
            lines_text = f"but its lines have {1e3 * printed_s:.3f} ms"
            yield f"ping's summary has {1e3 * summary_s:g} ms as the {name} time, {lines_text}"


def compare_with_capture(
    output: Ping, captured: CapturedPing, interval_s: float, role: str, *, is_requester: bool
) -> Iterator[str]:
    """Yield the contradictions between the output and one ping in a capture.

    Args:
        output: Parsed output of ping.
        captured: The echoes of one identifier.
        interval_s: Time between requests.
        role: Role of the capturing robot.
        is_requester: True if this robot sends the requests. The capture of the other robot contains the times at
            which the replies were sent, so times are not compared with it.
    """
    if output.transmitted is None or output.transmitted > _MAX_SEQUENCE:
        return
    if len(captured.requested_ns) > output.transmitted:
        sent_text = format_count(output.transmitted, "request")
        yield f"ping sent {sent_text}, but the {role}'s capture has {len(captured.requested_ns)}"
    answers_by_seq = {reply.seq: reply for reply in output.answers}
    not_captured = sorted(answers_by_seq.keys() - (captured.requested_ns.keys() & captured.replied_ns.keys()))
    if not_captured:
        reply_text = f"ping has a reply to request {not_captured[0]}"
        yield f"{reply_text}, but the {role}'s capture lacks the request or the reply"
    if not is_requester:
        return
    yield from _unprinted_replies(output, captured, interval_s, role)
    captured_replies = [reply for seq, reply in answers_by_seq.items() if seq not in not_captured]
    yield from _time_problems(output, captured_replies, captured, role)


def _unprinted_replies(output: Ping, captured: CapturedPing, interval_s: float, role: str) -> Iterator[str]:
    """Yield a contradiction if the output lacks replies that reached the robot while ping was running."""
    if not captured.requested_ns:
        return
    until_ns = max(captured.requested_ns.values()) + round(1e9 * (_WAIT_SHARE * interval_s - _UNREAD_S))
    printed = {reply.seq for reply in output.replies}
    missing = [
        seq
        for seq, at_ns in captured.replied_ns.items()
        if seq not in printed and seq in captured.requested_ns and at_ns <= until_ns
    ]
    if missing:
        answers = format_count(len(missing), "answer")
        yield f"the {role}'s capture has {answers} that ping did not print, the first to request {min(missing)}"


def _time_problems(output: Ping, answers: list[Reply], captured: CapturedPing, role: str) -> Iterator[str]:
    """Yield the contradictions between the printed times and the times in the requester's capture."""
    excess_s, print_delay_s, previous_sent_ns = [], [], 0.0
    is_busybox = output.first_seq == 0  # only busybox numbers the requests from 0
    factor = _BUSYBOX_FACTOR if is_busybox else 1
    for reply in sorted(answers, key=lambda answer: answer.seq):
        replied_ns = captured.replied_ns[reply.seq]
        if reply.rtt_s is not None:
            captured_s = (replied_ns - captured.requested_ns[reply.seq]) / 1e9
            difference_s, rounding_s = reply.rtt_s - captured_s, _ROUNDING * captured_s
            # The latest time at which ping sent the request, unless it read the reply late, as busybox does.
            sent_ns = replied_ns - 1e9 * (1 - _ROUNDING) * reply.rtt_s
            is_in_order = is_busybox or sent_ns >= previous_sent_ns
            if difference_s < -_MAX_EARLIER_S - rounding_s or not is_in_order:
                times = f"took {1e3 * reply.rtt_s:g} ms, but {1e3 * captured_s:.3f} ms in the {role}'s capture"
                yield f"reply {reply.seq} {times}"
                return
            previous_sent_ns = replied_ns - 1e9 * (1 + _ROUNDING) * reply.rtt_s
            excess_s.append(difference_s - rounding_s)
        if reply.at_utc_ns is not None:
            print_delay_s.append((reply.at_utc_ns - replied_ns) / 1e9)
    if len(excess_s) > 1 and median_low(excess_s) > factor * _MAX_MEDIAN_LATER_S:
        median_ms = 1e3 * median_low(excess_s)
        yield f"the median of its times is {median_ms:.1f} ms longer than in the {role}'s capture"
    if print_delay_s and (min(print_delay_s) < -_MAX_EARLIER_S or max(print_delay_s) > _MAX_PRINT_DELAY_S):
        worst_s = min(print_delay_s) if min(print_delay_s) < -_MAX_EARLIER_S else max(print_delay_s)
        yield f"a reply has a time stamp {worst_s:.3f} s after its arrival in the {role}'s capture"
    elif print_delay_s and median(print_delay_s) > _MAX_MEDIAN_PRINT_DELAY_S:
        median_s = median(print_delay_s)
        yield f"the median of its time stamps is {median_s:.3f} s later than in the {role}'s capture"
