"""The standard output of iputils' ping (`LC_ALL=C ping -n -D`), old and new, and of busybox's, line by line.

The old iputils, s20101006, says `icmp_req` for `icmp_seq`; busybox counts from 0, iputils from 1. Lines that none of
them prints are kept, and never fatal.
"""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.core.columns import Figure, Kind, Measured, columns
from fieldkit.measure.evidence import reading
from fieldkit.measure.evidence.survivors import quantile_of_sent

FILE: Final = "ping.txt"
"""What it said on its standard output."""

COLUMNS: Final = columns(
    20,
    ("rtt_sent", "count", "Echo requests sent."),
    ("rtt_received", "count", "Echo requests answered, duplicates not counted."),
    (
        "rtt_loss",
        "share",
        "1 - rtt_received/rtt_sent.",
        Figure("ping loss", Kind.COUNTED, "rtt_received", "rtt_sent", rank=16),
    ),
    ("rtt_payload_bytes", "B", "ICMP payload of each echo request."),
    ("rtt_min_s", "s", "Smallest round-trip time."),
    (
        "rtt_median_s",
        "s",
        "Median round-trip time.",
        Figure("RTT", Kind.MEDIAN, rank=30, of_sent="rtt_median_sent_s"),
    ),
    ("rtt_mean_s", "s", "Mean round-trip time."),
    ("rtt_p95_s", "s", "95th percentile of the round-trip time."),
    ("rtt_max_s", "s", "Largest round-trip time."),
    ("rtt_jitter_s", "s", "Mean absolute difference between one round-trip time and the next."),
)
SENT_COLUMNS: Final = columns(
    110,
    (
        "rtt_median_sent_s",
        "s",
        (
            "Median round-trip time over all echo requests, an unanswered one as later than every answer; empty when "
            "half of them or more stayed unanswered."
        ),
    ),
)
GAP_COLUMNS: Final = columns(
    20,
    (
        "rtt_gap_s",
        "s",
        (
            "Longest time from one answer to the next; empty when the ping began or ended in a longer one, or in one "
            "of 1 s or more, and when ping has no time stamps."
        ),
        Figure("longest gap between answers", Kind.MEDIAN, at_least="rtt_gap_at_least_s"),
    ),
    (
        "rtt_gap_lost",
        "count",
        "Echo requests without an answer in that time; empty as rtt_gap_s.",
        Figure("lost in the gap", Kind.MEDIAN, at_least="rtt_gap_lost_at_least"),
    ),
)
OPEN_GAP_COLUMNS: Final = columns(
    110,
    (
        "rtt_gap_at_least_s",
        "s",
        (
            "Lower bound of rtt_gap_s where the ping began or ended in the gap: the longest time without an answer "
            "that was observed. Empty otherwise."
        ),
    ),
    ("rtt_gap_lost_at_least", "count", "Lower bound of rtt_gap_lost, likewise."),
)
_SEQUENCES: Final = 1 << 16
"""Sequence numbers of ICMP."""
_LATE: Final = 1 << 10
"""An answer that is behind the one before it by fewer numbers is late; else the numbers began again."""

UNREMARKABLE_S: Final = 1.0
"""A shorter gap at either end of a ping, and shorter than the longest that ended, is taken for a lost echo."""
WAY_COLUMNS: Final = columns(
    40,
    (
        "rtt_distance_start_m",
        "m",
        "Distance between sender and receiver at the first reply to ping that has a time stamp.",
    ),
    ("rtt_distance_min_m", "m", "Smallest distance from that reply to the last."),
    ("rtt_distance_mean_m", "m", "Mean distance over that time."),
    ("rtt_distance_max_m", "m", "Largest distance in that time."),
    ("rtt_sender_speed_m_s", "m/s", "Mean speed of the sender over that time."),
    (
        "rtt_relative_speed_m_s",
        "m/s",
        "Mean magnitude of the sender's velocity less the receiver's over that time.",
    ),
)

_HEADER: Final = re.compile(
    r"PING .* (?P<payload>[0-9]{1,9})(?:\([0-9]{1,9}\) bytes of data\.|(?P<busybox> data bytes))\Z"
)
_STAMP: Final = r"(?:\[(?P<seconds>[0-9]{1,10})\.(?P<micros>[0-9]{6})\] )?"
_REPLY: Final = re.compile(
    _STAMP + r"(?P<size>[0-9]{1,9}) bytes from (?P<source>[^ ]+(?: \([^ ]+\))?):"
    r" (?:icmp_seq|icmp_req|seq)=(?P<seq>[0-9]{1,9})"
    r"(?: ttl=[0-9]{1,3})?(?: time=(?P<time>[0-9]{1,12}(?:\.[0-9]{1,9})?) ms)?"
    r"(?P<marks>(?: \([A-Z !]+\))*)\Z"
)
_PROBLEM: Final = re.compile(_STAMP + r"From (?P<source>[^ ]+?):? icmp_seq=(?P<seq>[0-9]{1,9}) (?P<text>.+)\Z")
_SUMMARY: Final = re.compile(
    r"(?P<sent>[0-9]{1,18}) packets transmitted, (?P<received>[0-9]{1,18})(?: packets)? received, .+\Z"
)
_MS: Final = r"[0-9]{1,9}\.[0-9]{1,9}"
_TIMES: Final = re.compile(
    rf"(?:rtt min/avg/max/mdev|round-trip min/avg/max) = (?P<min>{_MS})/(?P<avg>{_MS})/(?P<max>{_MS})(?:/{_MS})? ms"
)
_SILENT: Final = re.compile(
    r"|--- .+ ping statistics ---|rtt min/avg/max/mdev = .+ ms(?:, .+)?|round-trip min/avg/max = .+ ms"
    r"|(?:, )?pipe [0-9]+|(?:\[[0-9.]+\] )?no answer yet for icmp_seq=[0-9]+"
)


@dataclass(frozen=True)
class Reply:
    """One echo reply.

    Attributes:
        seq: Sequence number, 16 bits.
        rtt_s: Round-trip time in seconds; None with a payload too short for a time stamp.
        at_utc_ns: When it was printed, nanoseconds since 1970 UTC; None without `-D`.
        duplicate: Whether the request had been answered before.
        damaged: Whether its checksum was wrong; ping does not count it as received.
    """

    seq: int
    rtt_s: float | None
    at_utc_ns: int | None
    duplicate: bool
    damaged: bool


@dataclass(frozen=True)
class Problem:
    """An ICMP error in place of a reply.

    Attributes:
        seq: Sequence number of the request.
        source: Address of the host that says so.
        text: What it says, for example `Destination Host Unreachable`.
        at_utc_ns: When it was printed, nanoseconds since 1970 UTC; None without `-D`.
    """

    seq: int
    source: str
    text: str
    at_utc_ns: int | None


@dataclass(frozen=True)
class Ping:
    """Output of one run of ping.

    Attributes:
        payload_bytes: ICMP payload of a request; None without the header line.
        replies: Every reply in the order of arrival, duplicates too.
        problems: Every ICMP error.
        transmitted: Requests sent, by the summary; None when ping was ended before it.
        received: Requests answered, by the summary.
        unknown: Lines that are no ping's, as they stand.
        first_seq: Sequence number of the first request: 1, or busybox's 0.
        summary_s: Shortest, mean and longest round-trip time, by the summary; None if it has none.
    """

    payload_bytes: int | None
    replies: tuple[Reply, ...]
    problems: tuple[Problem, ...]
    transmitted: int | None
    received: int | None
    unknown: tuple[str, ...]
    first_seq: int = 1
    summary_s: tuple[float, float, float] | None = None

    @property
    def answers(self) -> tuple[Reply, ...]:
        """The replies that count: neither duplicate nor damaged."""
        return tuple(reply for reply in self.replies if not (reply.duplicate or reply.damaged))

    @property
    def rtt_s(self) -> tuple[float, ...]:
        """Round-trip times of the answers, in seconds."""
        return tuple(reply.rtt_s for reply in self.answers if reply.rtt_s is not None)

    @property
    def gaps(self) -> tuple[int, ...]:
        """Sequence numbers without an answer, from the first to the last one known to have been sent."""
        answered = {reply.seq for reply in self.answers}
        seen = answered | {problem.seq for problem in self.problems}
        end = max(seen, default=-1) + 1 if self.transmitted is None else self.first_seq + self.transmitted
        # The number has 16 bits; a longer run starts again at 0.
        return tuple(seq for seq in range(self.first_seq, min(end, 0x10000)) if seq not in answered)


def read(path: Path) -> Ping:
    """Return what a run of ping printed.

    Raises:
        EvidenceError: The file is missing or cannot be read.
    """
    return parse(reading.text(path))


def parse(text: str) -> Ping:
    """Return what `text` says; never raises, whatever it is."""
    payload_bytes = transmitted = received = None
    first_seq = 1
    summary_s = None
    replies: list[Reply] = []
    problems: list[Problem] = []
    unknown: list[str] = []
    for line in text.split("\n"):
        if match := _REPLY.match(line):
            replies.append(_reply(match))
        elif match := _PROBLEM.match(line):
            at_utc_ns = _at_utc_ns(match)
            problems.append(Problem(int(match["seq"]), match["source"], match["text"], at_utc_ns))
        elif match := _HEADER.match(line):
            payload_bytes = int(match["payload"])
            first_seq = 0 if match["busybox"] else 1
        elif match := _SUMMARY.match(line):
            transmitted, received = int(match["sent"]), int(match["received"])
        elif match := _TIMES.match(line):
            summary_s = (float(match["min"]) / 1e3, float(match["avg"]) / 1e3, float(match["max"]) / 1e3)
        elif not _SILENT.fullmatch(line):
            unknown.append(line)
    said = tuple(replies), tuple(problems), transmitted, received, tuple(unknown)
    return Ping(payload_bytes, *said, first_seq, summary_s)


@dataclass(frozen=True)
class AnswerGap:
    """The longest time without an answer in a ping.

    Attributes:
        lasted_s: From the answer before it to the one after it, in seconds; as far as observed if it is open.
        lost: Requests without an answer in it.
        is_open: Whether the ping began or ended in it, so that both numbers are lower bounds.
    """

    lasted_s: float
    lost: int
    is_open: bool


def longest_gap(found: Ping, interval_s: float) -> AnswerGap | None:
    """Return the longest time without an answer, by the order of requests; None if answers have no time stamps.

    A gap that the ping began or ended in is open. It counts where it is as long as the longest that has both ends, or
    lasts `UNREMARKABLE_S`.

    Args:
        found: The ping.
        interval_s: Time between two requests. Open gaps are counted in requests that were sent and not answered.
    """
    stamped = sorted(_numbered(found))
    if not stamped and (found.answers or not found.transmitted):
        return None
    ended = [(later_ns - ns, later - seq - 1) for (seq, ns), (later, later_ns) in pairwise(stamped)]
    gap_ns, lost = max(ended, default=(0, 0))
    unanswered = _open_ends(found, [seq for seq, _ in stamped])
    open_s = unanswered * interval_s
    if unanswered and (unanswered >= lost or open_s >= UNREMARKABLE_S):
        return AnswerGap(max(open_s, gap_ns / 1e9), max(unanswered, lost), is_open=True)
    return AnswerGap(gap_ns / 1e9, lost, is_open=False) if ended else None


def _numbered(found: Ping) -> Iterator[tuple[int, int]]:
    """Yield the number of the request and the time stamp of each answer that has one; 16 bits are unwrapped."""
    last: int | None = None
    for answer in found.answers:
        if answer.at_utc_ns is not None:
            ahead = 0 if last is None else (answer.seq - last + _LATE) % _SEQUENCES - _LATE
            last = answer.seq if last is None else last + ahead
            yield last, answer.at_utc_ns


def _open_ends(found: Ping, answered: Sequence[int]) -> int:
    """Return how many requests stayed unanswered before the first answer, or after the last, whichever is more."""
    sent = found.transmitted or 0
    if not answered:
        return sent
    return max(answered[0] - found.first_seq, found.first_seq + sent - 1 - answered[-1], 0)


def measure_gap(found: Ping | None, interval_s: float) -> Measured:
    """Return the columns of the longest gap between answers.

    Args:
        found: The ping; None if its output is not at hand.
        interval_s: As `longest_gap`.
    """
    gap = None if found is None else longest_gap(found, interval_s)
    if gap is None:
        return Measured.nothing((*GAP_COLUMNS, *OPEN_GAP_COLUMNS), "no two answers have a time stamp")
    ended, bounds = (tuple(column.name for column in columns) for columns in (GAP_COLUMNS, OPEN_GAP_COLUMNS))
    known, others = (bounds, ended) if gap.is_open else (ended, bounds)
    reason = "the ping began or ended in the gap" if gap.is_open else "the gap ended within the ping"
    values = dict(zip(known, (gap.lasted_s, gap.lost), strict=True))
    return Measured(values, dict.fromkeys(others, reason))


def _reply(match: re.Match[str]) -> Reply:
    return Reply(
        seq=int(match["seq"]),
        rtt_s=None if match["time"] is None else float(match["time"]) / 1e3,
        at_utc_ns=_at_utc_ns(match),
        duplicate="(DUP!)" in match["marks"],
        damaged="(BAD CHECKSUM!)" in match["marks"],
    )


def _at_utc_ns(match: re.Match[str]) -> int | None:
    if match["seconds"] is None:
        return None
    return int(match["seconds"]) * 1_000_000_000 + int(match["micros"]) * 1_000


def measure(pings: Ping | None) -> Measured:
    """Return the columns of what ping said; None where its output is not at hand."""
    # Without its first line ping never ran: no answer is then no measurement.
    if pings is None or pings.payload_bytes is None:
        return Measured.nothing((*COLUMNS, *SENT_COLUMNS), "ping did not run")
    rtt_s = pings.rtt_s
    counts = {
        "rtt_sent": pings.transmitted,
        "rtt_received": len(pings.answers),
        "rtt_loss": 1 - len(pings.answers) / pings.transmitted if pings.transmitted else None,
        "rtt_payload_bytes": pings.payload_bytes,
    }
    times = {
        "rtt_min_s": min(rtt_s, default=None),
        "rtt_median_s": float(np.median(rtt_s)) if rtt_s else None,
        "rtt_mean_s": float(np.mean(rtt_s)) if rtt_s else None,
        "rtt_p95_s": float(np.percentile(rtt_s, 95)) if rtt_s else None,
        "rtt_max_s": max(rtt_s, default=None),
        "rtt_jitter_s": float(np.abs(np.diff(rtt_s)).mean()) if len(rtt_s) > 1 else None,
    }
    of_sent = {"rtt_median_sent_s": quantile_of_sent(rtt_s, pings.transmitted or 0, 0.5)}
    return (
        Measured.of(counts, "ping was cut short")
        | Measured.of(times, "too few replies have a time")
        | Measured.of(of_sent, "half of the requests or more stayed unanswered")
    )
