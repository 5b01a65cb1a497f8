"""Parser for the standard output of ping (`LC_ALL=C ping -n -D`) of old and new iputils, and of busybox.

iputils s20101006 prints `icmp_req` instead of `icmp_seq`. busybox counts from 0, iputils from 1. Unknown lines are
stored and cause no error.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from fieldkit.core.columns import Figure, Kind, Measured, columns
from fieldkit.measure.evidence import reading
from fieldkit.measure.evidence.delay_quantiles import quantile_of_sent

FILE: Final = "ping.txt"
"""Standard output of ping."""

COLUMNS: Final = columns(
    20,
    ("rtt_sent", "count", "Echo requests sent."),
    ("rtt_received", "count", "Echo requests that were answered; duplicates are not counted."),
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
    ("rtt_jitter_s", "s", "Mean absolute difference between consecutive round-trip times."),
)
SENT_COLUMNS: Final = columns(
    110,
    (
        "rtt_median_sent_s",
        "s",
        (
            "Median round-trip time over all echo requests, in which the time of an unanswered request "
            "is infinite; empty if half of the requests or more were unanswered, and if ping was killed."
        ),
    ),
)
MOTION_COLUMNS: Final = columns(
    40,
    (
        "rtt_distance_start_m",
        "m",
        "Distance between sender and receiver at the first ping reply that has a time stamp.",
    ),
    ("rtt_distance_min_m", "m", "Smallest distance from the first ping reply to the last."),
    ("rtt_distance_mean_m", "m", "Mean distance from the first ping reply to the last."),
    ("rtt_distance_max_m", "m", "Largest distance from the first ping reply to the last."),
    ("rtt_sender_speed_m_s", "m/s", "Mean speed of the sender from the first ping reply to the last."),
    (
        "rtt_relative_speed_m_s",
        "m/s",
        "Mean magnitude of the relative velocity of sender and receiver from the first ping reply to the last.",
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
_IGNORED_LINE: Final = re.compile(
    r"|--- .+ ping statistics ---|rtt min/avg/max/mdev = .+ ms(?:, .+)?|round-trip min/avg/max = .+ ms"
    r"|(?:, )?pipe [0-9]+|(?:\[[0-9.]+\] )?no answer yet for icmp_seq=[0-9]+"
)


@dataclass(frozen=True)
class Reply:
    """One echo reply.

    Attributes:
        seq: Sequence number, 16 bits.
        rtt_s: Round-trip time in seconds; None if the payload is too short for a time stamp.
        at_utc_ns: Time of printing, nanoseconds since 1970 UTC; None without `-D`.
        duplicate: True if the request had been answered before.
        damaged: True if the checksum of the reply was wrong; ping does not count it as received.
    """

    seq: int
    rtt_s: float | None
    at_utc_ns: int | None
    duplicate: bool
    damaged: bool


@dataclass(frozen=True)
class Problem:
    """An ICMP error instead of a reply.

    Attributes:
        seq: Sequence number of the request.
        source: Address of the host that sent the error.
        text: The error, for example `Destination Host Unreachable`.
        at_utc_ns: Time of printing, nanoseconds since 1970 UTC; None without `-D`.
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
        replies: All replies in the order of arrival, including duplicates.
        problems: All ICMP errors.
        transmitted: Number of sent requests according to the summary; None if ping was killed before the summary.
        received: Number of answered requests according to the summary; None without a summary.
        unknown_lines: Unknown lines, unchanged.
        first_seq: Sequence number of the first request: 1, or 0 for busybox.
        summary_s: Shortest, mean and longest round-trip time according to the summary; None without these.
    """

    payload_bytes: int | None
    replies: tuple[Reply, ...]
    problems: tuple[Problem, ...]
    transmitted: int | None
    received: int | None
    unknown_lines: tuple[str, ...]
    first_seq: int = 1
    summary_s: tuple[float, float, float] | None = None

    @property
    def answers(self) -> tuple[Reply, ...]:
        """The replies that are neither duplicate nor damaged."""
        return tuple(reply for reply in self.replies if not (reply.duplicate or reply.damaged))

    @property
    def rtt_s(self) -> tuple[float, ...]:
        """Round-trip times of the answers, in seconds."""
        return tuple(reply.rtt_s for reply in self.answers if reply.rtt_s is not None)

    @property
    def unanswered_seqs(self) -> tuple[int, ...]:
        """Sequence numbers of the requests without an answer, up to the last request, but at most 65,535.

        Without a summary, the last request is the last one that a line of the output names.
        """
        answered_seqs = {reply.seq for reply in self.answers}
        printed_seqs = answered_seqs | {problem.seq for problem in self.problems}
        end = max(printed_seqs, default=-1) + 1 if self.transmitted is None else self.first_seq + self.transmitted
        # A sequence number has 16 bits and wraps to 0 in a longer run.
        return tuple(seq for seq in range(self.first_seq, min(end, 0x10000)) if seq not in answered_seqs)


def read(path: Path) -> Ping:
    """Return the parsed output of a run of ping.

    Raises:
        EvidenceError: The file is missing or cannot be read.
    """
    return parse(reading.text(path))


def parse(text: str) -> Ping:
    """Return the parsed output of a run of ping. Any text is accepted."""
    payload_bytes = transmitted = received = None
    first_seq = 1
    summary_s = None
    replies: list[Reply] = []
    problems: list[Problem] = []
    unknown_lines: list[str] = []
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
        elif not _IGNORED_LINE.fullmatch(line):
            unknown_lines.append(line)
    parsed = tuple(replies), tuple(problems), transmitted, received, tuple(unknown_lines)
    return Ping(payload_bytes, *parsed, first_seq, summary_s)


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


def measure(output: Ping | None) -> Measured:
    """Return the columns of a run of ping. `output` is None if it is not available."""
    # Without the header line, ping did not run, so missing answers are not a measured loss.
    if output is None or output.payload_bytes is None:
        return Measured.all_missing((*COLUMNS, *SENT_COLUMNS), "ping did not run")
    rtt_s = output.rtt_s
    counts = {
        "rtt_sent": output.transmitted,
        "rtt_received": len(output.answers),
        "rtt_loss": 1 - len(output.answers) / output.transmitted if output.transmitted else None,
        "rtt_payload_bytes": output.payload_bytes,
    }
    times = {
        "rtt_min_s": min(rtt_s, default=None),
        "rtt_median_s": float(np.median(rtt_s)) if rtt_s else None,
        "rtt_mean_s": float(np.mean(rtt_s)) if rtt_s else None,
        "rtt_p95_s": float(np.percentile(rtt_s, 95)) if rtt_s else None,
        "rtt_max_s": max(rtt_s, default=None),
        "rtt_jitter_s": float(np.abs(np.diff(rtt_s)).mean()) if len(rtt_s) > 1 else None,
    }
    # Without the summary, the number of requests is unknown.
    sent = output.transmitted
    of_sent = {"rtt_median_sent_s": None if sent is None else quantile_of_sent(rtt_s, sent, 0.5)}
    return (
        Measured.from_optional(counts, "ping was killed before its summary")
        | Measured.from_optional(times, "too few replies have a time")
        | Measured.from_optional(
            of_sent, "half of the requests or more were unanswered, or ping was killed before its summary"
        )
    )
