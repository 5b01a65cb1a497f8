"""The standard output of iputils' ping (`LC_ALL=C ping -n -D`), old and new, and of busybox's, line by line.

The old iputils, s20101006, says `icmp_req` for `icmp_seq`; busybox counts from 0, iputils from 1. Lines that none of
them prints are kept, and never fatal.
"""

import re
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.core.columns import Figure, Kind, Measured, columns
from fieldkit.core.lazy import dataclass
from fieldkit.measure.evidence import reading

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
        Figure("echo loss", Kind.COUNTED, "rtt_received", "rtt_sent", rank=16),
    ),
    ("rtt_payload_bytes", "B", "ICMP payload of each echo request."),
    ("rtt_min_s", "s", "Smallest round-trip time."),
    ("rtt_median_s", "s", "Median round-trip time.", Figure("RTT", Kind.MEDIAN, rank=30)),
    ("rtt_mean_s", "s", "Mean round-trip time."),
    ("rtt_p95_s", "s", "95th percentile of the round-trip time."),
    ("rtt_max_s", "s", "Largest round-trip time."),
    ("rtt_jitter_s", "s", "Mean absolute difference between one round-trip time and the next."),
)
GAP_COLUMNS: Final = columns(
    20,
    (
        "rtt_gap_s",
        "s",
        (
            "Longest time from one answer to the next; empty when the last requests stayed unanswered for longer, or "
            "ping has no time stamps."
        ),
        Figure("longest gap between answers", Kind.MEDIAN),
    ),
    (
        "rtt_gap_lost",
        "count",
        "Echo requests without an answer in that time; empty as rtt_gap_s.",
        Figure("lost in the gap", Kind.MEDIAN),
    ),
)
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
    """

    payload_bytes: int | None
    replies: tuple[Reply, ...]
    problems: tuple[Problem, ...]
    transmitted: int | None
    received: int | None
    unknown: tuple[str, ...]
    first_seq: int = 1

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
        elif not _SILENT.fullmatch(line):
            unknown.append(line)
    return Ping(payload_bytes, tuple(replies), tuple(problems), transmitted, received, tuple(unknown), first_seq)


def longest_gap(found: Ping) -> tuple[float, int] | None:
    """Return the longest time in seconds from one answer to the next, by their requests, and how many are between.

    None where no two answers have a time stamp, or the requests after the last one are at least as many: that gap has
    no end.
    """
    stamped = sorted((answer.seq, answer.at_utc_ns) for answer in found.answers if answer.at_utc_ns is not None)
    gaps = [(later_ns - ns, later - seq - 1) for (seq, ns), (later, later_ns) in pairwise(stamped)]
    if not gaps:
        return None
    gap_ns, lost = max(gaps)
    unanswered_since = sum(seq > stamped[-1][0] for seq in found.gaps)
    return None if unanswered_since and unanswered_since >= lost else (gap_ns / 1e9, lost)


def measure_gap(found: Ping | None) -> Measured:
    """Return the columns of the longest gap between answers; `found` is None where ping's output is not at hand."""
    gap = None if found is None else longest_gap(found)
    if gap is None:
        return Measured.nothing(GAP_COLUMNS, "no two answers have a time stamp, or the gap did not end")
    return Measured({"rtt_gap_s": gap[0], "rtt_gap_lost": gap[1]})


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
        return Measured.nothing(COLUMNS, "ping did not run")
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
    return Measured.of(counts, "ping was cut short") | Measured.of(times, "too few replies have a time")
