"""Output of `iperf3 --json` from either end of a test, for version 3.1 and later.

The totals at the end differ between versions: the server of a UDP test reports 0 bytes, and 3.1 has one total for
both ends. The counters of each interval are the same in all versions (checked with 3.1.3, 3.7, 3.12 and 3.17), so the
columns are sums over the intervals. If the connection of a test was interrupted, the last interval is missing and the
JSON has the key `error`.
"""

import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any, Final

from fieldkit.core.columns import Figure, Kind, Measured, columns
from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol, Role
from fieldkit.core.text import shorten
from fieldkit.measure.evidence import reading
from fieldkit.measure.evidence.iperf3_json import (
    IperfStart,
    IperfTotals,
    count,
    items,
    mapping,
    number,
    parse_start,
    parse_totals,
)

COLUMNS: Final = columns(
    100,
    (
        "iperf3_throughput_bit_s",
        "bit/s",
        (
            "Payload rate at iperf3's receiver over the full seconds of the test; the first second is excluded if "
            "there are at least three."
        ),
        Figure("iperf3 throughput", Kind.MEDIAN, rank=60),
    ),
    (
        "iperf3_interval_min_bit_s",
        "bit/s",
        "Smallest payload rate of a second that iperf3_throughput_bit_s includes.",
        Figure("iperf3 slowest second", Kind.MEDIAN, rank=61),
    ),
    ("iperf3_interval_median_bit_s", "bit/s", "Median payload rate of the seconds of iperf3_throughput_bit_s."),
    ("iperf3_sent_bytes", "B", "Payload sent, as reported by iperf3's sender."),
    ("iperf3_received_bytes", "B", "Payload received, as reported by iperf3's receiver."),
    ("iperf3_datagrams_sent", "count", "UDP datagrams that iperf3's receiver expected. Empty for TCP."),
    (
        "iperf3_datagrams_received",
        "count",
        "Datagrams of iperf3_datagrams_sent that iperf3's receiver received. Empty for TCP.",
    ),
    (
        "iperf3_loss",
        "share",
        "1 - iperf3_datagrams_received/iperf3_datagrams_sent. Empty for TCP.",
        Figure("iperf3 loss", Kind.COUNTED, "iperf3_datagrams_received", "iperf3_datagrams_sent", rank=62),
    ),
    (
        "iperf3_jitter_s",
        "s",
        (
            "Interarrival jitter (RFC 3550, section 6.4.1) as reported by iperf3 after the last datagram. It depends "
            "on about the last 16 datagrams; for the whole test see iperf3_captured_jitter_mean_s. Empty for TCP."
        ),
        Figure("iperf3's last jitter value (RFC 3550)", Kind.MEDIAN, rank=63),
    ),
    (
        "iperf3_retransmits",
        "count",
        "Segments that the sender's kernel retransmitted. Empty for UDP, and if its system does not report them.",
        Figure("iperf3 retransmissions", Kind.MEAN, rank=64),
    ),
)

_UDP_COLUMNS: Final = ("iperf3_datagrams_sent", "iperf3_datagrams_received", "iperf3_loss", "iperf3_jitter_s")
_TCP_COLUMNS: Final = ("iperf3_retransmits",)
_MAX_BYTES: Final = 16 << 20
"""Maximum size of the JSON. One hour with 8 streams and intervals of 1 s has 8 MB."""
# cJSON before 1.5.9 printed nan and inf, which are not valid JSON.
_INVALID_NUMBER: Final = re.compile(r"(?<=[:,\[])(\s*)[-+]?(?:nan|inf(?:inity)?)\b(?=\s*[,\]}])", re.IGNORECASE)
_MIN_INTERVALS: Final = 3
"""The first full interval is excluded if there are at least this many."""
_MIN_LENGTH_SHARE: Final = 0.5
"""An interval that is shorter than this share of the longest one is not a full interval, but the end of the test. On
a link with losses, it contains some tenths of a second without data, until the receiver is notified of the end.
"""


def json_file(role: Role) -> str:
    """Return the name of the file with the output of iperf3 on a robot."""
    return f"{role}-iperf3.json"


@dataclass(frozen=True)
class IperfInterval:
    """One interval of a test at one end, summed over all streams. A value is None if this end does not report it.

    Attributes:
        duration_s: Duration in seconds.
        payload_bytes: Payload sent or received.
        datagrams: UDP datagrams; at the receiver, the datagrams that it expected.
        lost: Expected datagrams that the receiver did not receive.
        retransmits: Retransmitted segments.
        start_s: Start in seconds after the start of the test; None if the JSON does not contain it.
        end_s: End in seconds after the start of the test; None if the JSON does not contain it.
        stream_bytes: Sum of the payloads of the streams; None without streams.
        rate_bit_s: Payload bits per second as printed by iperf3.
    """

    duration_s: float
    payload_bytes: int
    datagrams: int | None
    lost: int | None
    retransmits: int | None
    start_s: float | None = None
    end_s: float | None = None
    stream_bytes: int | None = None
    rate_bit_s: float | None = None

    @property
    def bit_s(self) -> float:
        """Payload bits per second."""
        return 8 * self.payload_bytes / self.duration_s


@dataclass(frozen=True)
class IperfTest:
    """Result of a test as reported by one end.

    Attributes:
        error: Error message of iperf3; empty if there was none.
        ports: Local and remote port of each data connection.
        intervals: Intervals in order, without omitted ones (`--omit`).
        jitter_s: Jitter at the end of the test, in seconds; None if not reported.
        start: Parameters of the test.
        totals: Totals at the end of the test.
    """

    error: str
    ports: tuple[tuple[int, int], ...]
    intervals: tuple[IperfInterval, ...]
    jitter_s: float | None
    start: IperfStart = field(default_factory=IperfStart)
    totals: IperfTotals = field(default_factory=IperfTotals)

    @property
    def _full_intervals(self) -> tuple[IperfInterval, ...]:
        longest_s = max((interval.duration_s for interval in self.intervals), default=0.0)
        return tuple(interval for interval in self.intervals if interval.duration_s >= _MIN_LENGTH_SHARE * longest_s)

    @property
    def steady_intervals(self) -> tuple[IperfInterval, ...]:
        """The full intervals; the first one is excluded if there are at least three.

        In the first interval, TCP is in slow start, and the receiver waits for the first packet.
        """
        full = self._full_intervals
        return full[1:] if len(full) >= _MIN_INTERVALS else full

    @property
    def window_s(self) -> tuple[float, float]:
        """Start and end of the steady intervals, in seconds after the start of the first full interval."""
        start_s = sum(
            interval.duration_s
            for interval in self._full_intervals[: len(self._full_intervals) - len(self.steady_intervals)]
        )
        return start_s, start_s + sum(interval.duration_s for interval in self.steady_intervals)


def read(path: Path) -> IperfTest:
    """Return the result that one end reported.

    Raises:
        EvidenceError: The file is missing, or is not complete JSON of iperf3, for example because iperf3 was killed.
    """
    if reading.size(path) > _MAX_BYTES:
        raise EvidenceError(f"is longer than {_MAX_BYTES >> 20} MiB", where=str(path))
    try:
        return parse(reading.text(path))
    except EvidenceError as error:
        raise EvidenceError(error.what, where=str(path)) from error


def parse(text: str) -> IperfTest:
    """Return the result in a text, which may start with lines that are not JSON.

    Raises:
        EvidenceError: The text is not JSON of iperf3.
    """
    try:
        document, _ = json.JSONDecoder().raw_decode(_INVALID_NUMBER.sub(r"\1null", text), max(text.find("{"), 0))
    except (ValueError, RecursionError) as error:
        raise EvidenceError("is not JSON of iperf3, or was truncated: was iperf3 killed?") from error
    if not isinstance(document, dict) or not {"start", "intervals"} & document.keys():
        raise EvidenceError("is JSON, but not of iperf3")
    start, end = mapping(document, "start"), mapping(document, "end")
    jitters_ms = [number(mapping(end, name), "jitter_ms") for name in ("sum_received", "sum")]
    jitter_ms = next((value for value in jitters_ms if value is not None), None)
    return IperfTest(
        error=shorten(str(document.get("error", ""))),
        ports=tuple(_ports(start)),
        intervals=tuple(_intervals(document)),
        jitter_s=None if jitter_ms is None else jitter_ms / 1e3,
        start=parse_start(document),
        totals=parse_totals(document),
    )


def _intervals(document: Mapping[str, Any]) -> Iterator[IperfInterval]:
    """Yield the intervals of a test, without omitted and incomplete ones."""
    for interval in items(document, "intervals"):
        total = mapping(interval, "sum")
        duration_s, payload_bytes = number(total, "seconds"), count(total, "bytes")
        if total.get("omitted") is True or not duration_s or payload_bytes is None:
            continue
        datagrams, lost, retransmits = (count(total, name) for name in ("packets", "lost_packets", "retransmits"))
        streams = [count(stream, "bytes") for stream in items(interval, "streams")]
        yield IperfInterval(
            duration_s,
            payload_bytes,
            datagrams,
            lost,
            retransmits,
            start_s=number(total, "start"),
            end_s=number(total, "end"),
            stream_bytes=_sum(streams),
            rate_bit_s=number(total, "bits_per_second"),
        )


def _ports(start: Mapping[str, Any]) -> Iterator[tuple[int, int]]:
    for connection in items(start, "connected"):
        local, remote = count(connection, "local_port"), count(connection, "remote_port")
        if local is not None and remote is not None:
            yield local, remote


def measure(protocol: Protocol, sender: IperfTest | None, receiver: IperfTest | None) -> Measured:
    """Return the columns of a test. `sender` or `receiver` is None if the result of this end is not available."""
    sent, received = (test.intervals if test else () for test in (sender, receiver))
    received_bytes = sum(interval.payload_bytes for interval in received) if received else None
    steady_intervals = receiver.steady_intervals if receiver else ()
    rates = [interval.bit_s for interval in steady_intervals]
    duration_s = sum(interval.duration_s for interval in steady_intervals)
    datagrams, lost = (_sum([getattr(interval, name) for interval in received]) for name in ("datagrams", "lost"))
    arrived = None if datagrams is None or lost is None else max(datagrams - lost, 0)
    values = {
        "iperf3_throughput_bit_s": 8 * sum(interval.payload_bytes for interval in steady_intervals) / duration_s
        if steady_intervals
        else None,
        "iperf3_interval_min_bit_s": min(rates, default=None),
        "iperf3_interval_median_bit_s": median(rates) if rates else None,
        "iperf3_sent_bytes": sum(interval.payload_bytes for interval in sent) if sent else None,
        "iperf3_received_bytes": received_bytes,
        "iperf3_datagrams_sent": datagrams,
        "iperf3_datagrams_received": arrived,
        "iperf3_loss": 1 - arrived / datagrams if arrived is not None and datagrams else None,
        "iperf3_jitter_s": receiver.jitter_s if receiver else None,
        "iperf3_retransmits": _sum([interval.retransmits for interval in sent]),
    }
    other_protocol_names = _TCP_COLUMNS if protocol is Protocol.UDP else _UDP_COLUMNS
    applicable = {name: value for name, value in values.items() if name not in other_protocol_names}
    other_columns = [column for column in COLUMNS if column.name in other_protocol_names]
    return Measured.from_optional(applicable, "iperf3 does not report it") | Measured.all_missing(
        other_columns, f"not for {protocol}"
    )


def _sum(counts: list[int | None]) -> int | None:
    """Return the sum of the counts, or None if there are no counts or one of them is None."""
    present = [count for count in counts if count is not None]
    return sum(present) if present and len(present) == len(counts) else None
