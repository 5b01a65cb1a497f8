"""Contradictions within the output of ping, and between it and captures around it.

Round-trip times of iputils' ping differed from captured ones by -0.03 to 0.9 ms, the median by less than 0.1 ms, on a
busy machine with 2 cores. busybox takes the time of a reply when it wakes up, iputils has it from the kernel.
"""

from collections.abc import Iterator
from statistics import median
from typing import Final

from fieldkit.core.crosschecks import CrossCheck
from fieldkit.core.units import format_count
from fieldkit.measure.evidence.ping import Ping, Reply
from fieldkit.measure.transfers.echoes import CapturedPing

_ROUNDING: Final = 0.006
"""ping prints three digits."""
_EARLIER_S: Final = 0.000_2
_LATER_S: Final = 0.020
"""One reply: how much longer than in the capture, because something kept ping from running."""
_MEDIAN_LATER_S: Final = 0.001
_BUSYBOX_TIMES: Final = 5
"""How much more busybox may be late."""
_PRINTED_S: Final = 1.0
_MEDIAN_PRINTED_S: Final = 0.05
_WRAPS: Final = 0xFFFF
_STILL_THERE: Final = 0.9
"""After its last request ping waits for its interval at least, less what a timer may be early."""
_UNREAD_S: Final = 0.1
"""It may end before it reads a reply that came, if something kept it from running."""
_CLOCK_S: Final = 1.0

CROSS_CHECKS: Final = (
    CrossCheck(
        "requests and replies",
        ("rtt_sent", "rtt_received", "rtt_loss", "rtt_gap_lost*"),
        "`ping.txt`: reply lines and summary",
        ("the procedure: count", "each capture: echoes by sequence number", "the same file: summary beside lines"),
        "a reply in the last 0.1 s of ping, or later than one interval after the last request",
    ),
    CrossCheck(
        "round-trip time of each reply",
        ("rtt_*_s", "paper_delay_s", "paper_transfer_s"),
        "`ping.txt`: `time=`",
        ("sender's capture: request to whole reply", "the same file: min/avg/max"),
        "0.6 % (3 digits) and 20 ms in one reply, 1 ms in the median (busybox 5 times as much): a busy robot",
    ),
    CrossCheck(
        "moment of each reply",
        ("rtt_gap_s", "rtt_gap_at_least_s", "rtt_distance_*", "rtt_*_speed_m_s"),
        "`ping.txt`: time stamps in brackets",
        ("sender's capture: time of the reply", "the robot's clock before and after"),
        "1 s for one reply, 50 ms in the median, because ping stamps what it prints",
    ),
    CrossCheck(
        "payload of a request",
        ("rtt_payload_bytes", "paper_window_bytes"),
        "`ping.txt`: first line",
        ("the procedure", "each capture: size of echoes"),
        "none",
    ),
)


def within(said: Ping, count: int, payload_bytes: int, window: tuple[int, int] | None) -> Iterator[str]:
    """Yield the contradictions within the output, and with what was asked.

    Args:
        said: The output.
        count: Requests that the procedure asks for.
        payload_bytes: Payload that it asks for.
        window: The robot's clock before and after the attempt, nanoseconds since 1970 UTC; None if unknown.
    """
    if said.transmitted is not None and said.transmitted > count:
        yield f"ping sent {said.transmitted} requests of {count}"
    if said.payload_bytes is not None and said.payload_bytes != payload_bytes:
        yield f"ping sent {said.payload_bytes} bytes, and {payload_bytes} were asked for"
    last = None if said.transmitted is None else said.first_seq + said.transmitted - 1
    strange = [reply.seq for reply in said.replies if last is not None and not said.first_seq <= reply.seq <= last]
    if strange and last is not None and last <= _WRAPS:
        yield f"ping has an answer to request {strange[0]} of {said.transmitted}"
    yield from _summary(said)
    moments = [reply.at_utc_ns for reply in said.replies if reply.at_utc_ns is not None]
    if window is not None and moments:
        slack_ns = round(1e9 * _CLOCK_S)
        if min(moments) < window[0] - slack_ns or max(moments) > window[1] + slack_ns:
            yield "ping has an answer from before or after the attempt, by the robot's clock"


def _summary(said: Ping) -> Iterator[str]:
    times_s = [reply.rtt_s for reply in said.replies if reply.rtt_s is not None and not reply.damaged]
    if said.summary_s is None or not times_s:
        return
    of_lines = min(times_s), sum(times_s) / len(times_s), max(times_s)
    for name, summed_s, printed_s in zip(("shortest", "mean", "longest"), said.summary_s, of_lines, strict=True):
        if abs(summed_s - printed_s) > _ROUNDING * max(summed_s, printed_s) + 2e-6:
            beside = f"and its lines {1e3 * printed_s:.3f} ms"
            yield f"ping's summary has {1e3 * summed_s:g} ms as the {name} time, {beside}"


def beside(said: Ping, captured: CapturedPing, interval_s: float, role: str, *, asks: bool) -> Iterator[str]:
    """Yield the contradictions between the output and one ping in a capture.

    Args:
        said: The output.
        captured: The echoes of one identifier.
        interval_s: Time from one request to the next.
        role: Whose capture.
        asks: Whether this robot pings; else it answers, and sees when replies leave.
    """
    if said.transmitted is None or said.transmitted > _WRAPS:
        return
    if len(captured.requested_ns) > said.transmitted:
        yield f"ping sent {said.transmitted} requests, and the {role}'s capture holds {len(captured.requested_ns)}"
    answers = {reply.seq: reply for reply in said.answers}
    unseen = sorted(answers.keys() - (captured.requested_ns.keys() & captured.replied_ns.keys()))
    if unseen:
        yield f"ping has an answer to request {unseen[0]}, and the {role}'s capture does not hold both"
    if not asks:
        return
    yield from _unprinted(said, captured, interval_s, role)
    both = [reply for seq, reply in answers.items() if seq not in unseen]
    yield from _times(said, both, captured, role)


def _unprinted(said: Ping, captured: CapturedPing, interval_s: float, role: str) -> Iterator[str]:
    """Yield whether replies reached the robot while its ping ran, and it did not print them."""
    if not captured.requested_ns:
        return
    until_ns = max(captured.requested_ns.values()) + round(1e9 * (_STILL_THERE * interval_s - _UNREAD_S))
    printed = {reply.seq for reply in said.replies}
    missing = [
        seq
        for seq, at_ns in captured.replied_ns.items()
        if seq not in printed and seq in captured.requested_ns and at_ns <= until_ns
    ]
    if missing:
        what = format_count(len(missing), "answer")
        yield f"the {role}'s capture holds {what} that ping did not print, to request {min(missing)} first"


def _times(said: Ping, answers: list[Reply], captured: CapturedPing, role: str) -> Iterator[str]:
    later_s, printed_s = [], []
    busy = _BUSYBOX_TIMES if said.first_seq == 0 else 1
    for reply in answers:
        replied_ns = captured.replied_ns[reply.seq]
        if reply.rtt_s is not None:
            seen_s = (replied_ns - captured.requested_ns[reply.seq]) / 1e9
            more_s, rounding_s = reply.rtt_s - seen_s, _ROUNDING * seen_s
            if not -_EARLIER_S - rounding_s <= more_s <= busy * _LATER_S + rounding_s:
                took = f"took {1e3 * reply.rtt_s:g} ms, and in the {role}'s capture {1e3 * seen_s:.3f} ms"
                yield f"answer {reply.seq} {took}"
                return
            later_s.append(more_s - rounding_s)
        if reply.at_utc_ns is not None:
            printed_s.append((reply.at_utc_ns - replied_ns) / 1e9)
    if later_s and median(later_s) > busy * _MEDIAN_LATER_S:
        yield f"its times are {1e3 * median(later_s):.1f} ms longer than in the {role}'s capture, in the median"
    if printed_s and (min(printed_s) < -_EARLIER_S or max(printed_s) > _PRINTED_S):
        worst_s = min(printed_s) if min(printed_s) < -_EARLIER_S else max(printed_s)
        yield f"an answer has a time stamp {worst_s:.3f} s after it came, by the {role}'s capture"
    elif printed_s and median(printed_s) > _MEDIAN_PRINTED_S:
        yield f"its time stamps are {median(printed_s):.3f} s after the answers came, by the {role}'s capture"
