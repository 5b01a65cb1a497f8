"""Output of iperf3 (`--json`), of either end of a test, from version 3.1 on.

Versions differ in what they sum up at the end, and where: of a UDP test a server says 0 bytes, 3.1 has one sum for
both ends. What they count in each interval is the same in all, tried with 3.1.3, 3.7, 3.12 and 3.17, so figures are
sums over those. A test whose end did not say good-bye lacks its last interval, and its JSON says `error`.
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
from fieldkit.core.text import brief
from fieldkit.measure.evidence import reading
from fieldkit.measure.evidence.iperf3_summary import IperfStart, IperfTotals, parse_start, parse_totals
from fieldkit.measure.evidence.json_fields import count, items, mapping, number

COLUMNS: Final = columns(
    100,
    (
        "iperf3_throughput_bit_s",
        "bit/s",
        "Payload per second, by iperf3's receiver: of its whole seconds but the first, if there are three.",
        Figure("iperf3 throughput", Kind.MEDIAN, rank=60),
    ),
    (
        "iperf3_interval_min_bit_s",
        "bit/s",
        "The same in the slowest of these seconds.",
        Figure("iperf3 slowest second", Kind.MEDIAN, rank=61),
    ),
    ("iperf3_interval_median_bit_s", "bit/s", "The same in the median of these seconds."),
    ("iperf3_sent_bytes", "B", "Payload that iperf3 sent, by its sender."),
    ("iperf3_received_bytes", "B", "Payload that it received, by its receiver."),
    ("iperf3_datagrams_sent", "count", "UDP datagrams that its receiver expected. Empty for TCP."),
    ("iperf3_datagrams_received", "count", "Of these, the ones that it got. Empty for TCP."),
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
            "Interarrival jitter (RFC 3550, section 6.4.1) by iperf3 itself, after the last datagram: the last 16 or "
            "so decide it. Of the whole test: iperf3_captured_jitter_mean_s. Empty for TCP."
        ),
        Figure("iperf3's last jitter value (RFC 3550)", Kind.MEDIAN, rank=63),
    ),
    (
        "iperf3_retransmits",
        "count",
        "Segments that the sender's kernel sent again. Empty for UDP, and where it cannot tell.",
        Figure("iperf3 retransmissions", Kind.MEAN, rank=64),
    ),
)

_OF_UDP: Final = ("iperf3_datagrams_sent", "iperf3_datagrams_received", "iperf3_loss", "iperf3_jitter_s")
_OF_TCP: Final = ("iperf3_retransmits",)
_MOST_BYTES: Final = 16 << 20
"""An hour of intervals of 1 s, of 8 streams, is 8 MB."""
# cJSON before 1.5.9 printed what is no number as C does, which no JSON has.
_NO_NUMBER: Final = re.compile(r"(?<=[:,\[])(\s*)[-+]?(?:nan|inf(?:inity)?)\b(?=\s*[,\]}])", re.IGNORECASE)
_ENOUGH: Final = 3
_WHOLE: Final = 0.5
"""An interval shorter than this share of the longest is what was left at the end, while the receiver waited to be
told of it: on a link with losses for some tenths of a second in which nothing came."""


def json_file(role: Role) -> str:
    """Return the file of what the iperf3 on a robot said."""
    return f"{role}-iperf3.json"


@dataclass(frozen=True)
class IperfInterval:
    """One interval of a test at one end, all of its streams together; None where that end does not count it.

    Attributes:
        lasted_s: Its length in seconds.
        payload_bytes: Payload sent, or received.
        datagrams: UDP datagrams, at the receiver those that it expected.
        lost: Of these, the ones that the receiver missed.
        retransmits: Segments sent again.
        start_s: Its start in seconds; None if the JSON does not say.
        end_s: Its end, likewise.
        stream_bytes: Payload of each stream in it, added up; None without streams.
        rate_bit_s: Payload bits per second, as iperf3 wrote them.
    """

    lasted_s: float
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
        return 8 * self.payload_bytes / self.lasted_s


@dataclass(frozen=True)
class IperfTest:
    """A test as one end tells it.

    Attributes:
        error: What went wrong; empty where nothing did.
        ports: Ports of this end's data connections, and of the other's.
        intervals: Intervals in order, those that iperf3 was told to omit left out.
        jitter_s: Jitter at the end, in seconds; None where it tells none.
        start: Parameters of the test.
        totals: Totals at its end.
    """

    error: str
    ports: tuple[tuple[int, int], ...]
    intervals: tuple[IperfInterval, ...]
    jitter_s: float | None
    start: IperfStart = field(default_factory=IperfStart)
    totals: IperfTotals = field(default_factory=IperfTotals)

    @property
    def _whole(self) -> tuple[IperfInterval, ...]:
        longest_s = max((interval.lasted_s for interval in self.intervals), default=0.0)
        return tuple(interval for interval in self.intervals if interval.lasted_s >= _WHOLE * longest_s)

    @property
    def steady(self) -> tuple[IperfInterval, ...]:
        """The whole intervals but the first, if there are three.

        In the first one TCP finds its rate, and the receiver waits for the first packet.
        """
        whole = self._whole
        return whole[1:] if len(whole) >= _ENOUGH else whole

    @property
    def window_s(self) -> tuple[float, float]:
        """From when on, and until when, these are, in seconds from the first packet on."""
        start_s = sum(interval.lasted_s for interval in self._whole[: len(self._whole) - len(self.steady)])
        return start_s, start_s + sum(interval.lasted_s for interval in self.steady)


def read(path: Path) -> IperfTest:
    """Return what one end said.

    Raises:
        EvidenceError: The file is missing, or no JSON of iperf3: that was cut, as where it was killed.
    """
    if reading.size(path) > _MOST_BYTES:
        raise EvidenceError(f"is longer than {_MOST_BYTES >> 20} MiB", where=str(path))
    try:
        return parse(reading.text(path))
    except EvidenceError as error:
        raise EvidenceError(error.what, where=str(path)) from error


def parse(text: str) -> IperfTest:
    """Return what a text says, which may begin with lines that are no JSON.

    Raises:
        EvidenceError: It is no JSON of iperf3.
    """
    try:
        found, _ = json.JSONDecoder().raw_decode(_NO_NUMBER.sub(r"\1null", text), max(text.find("{"), 0))
    except (ValueError, RecursionError) as error:
        raise EvidenceError("is no JSON of iperf3, or was cut: did iperf3 end by itself?") from error
    if not isinstance(found, dict) or not {"start", "intervals"} & found.keys():
        raise EvidenceError("is JSON, but none of iperf3")
    start, end = mapping(found, "start"), mapping(found, "end")
    jitters_ms = [number(mapping(end, name), "jitter_ms") for name in ("sum_received", "sum")]
    jitter_ms = next((one for one in jitters_ms if one is not None), None)
    return IperfTest(
        error=brief(str(found.get("error", ""))),
        ports=tuple(_ports(start)),
        intervals=tuple(_intervals(found)),
        jitter_s=None if jitter_ms is None else jitter_ms / 1e3,
        start=parse_start(found),
        totals=parse_totals(found),
    )


def _intervals(found: Mapping[str, Any]) -> Iterator[IperfInterval]:
    for interval in items(found, "intervals"):
        total = mapping(interval, "sum")
        lasted_s, payload_bytes = number(total, "seconds"), count(total, "bytes")
        if total.get("omitted") is True or not lasted_s or payload_bytes is None:
            continue
        datagrams, lost, again = (count(total, name) for name in ("packets", "lost_packets", "retransmits"))
        streams = [count(stream, "bytes") for stream in items(interval, "streams")]
        yield IperfInterval(
            lasted_s,
            payload_bytes,
            datagrams,
            lost,
            again,
            start_s=number(total, "start"),
            end_s=number(total, "end"),
            stream_bytes=_sum(streams),
            rate_bit_s=number(total, "bits_per_second"),
        )


def _ports(start: Mapping[str, Any]) -> Iterator[tuple[int, int]]:
    for connection in items(start, "connected"):
        own, other = count(connection, "local_port"), count(connection, "remote_port")
        if own is not None and other is not None:
            yield own, other


def measure(protocol: Protocol, sender: IperfTest | None, receiver: IperfTest | None) -> Measured:
    """Return the columns of a test by what both ends say; None for an end whose word is not at hand."""
    sent, received = (test.intervals if test else () for test in (sender, receiver))
    received_bytes = sum(interval.payload_bytes for interval in received) if received else None
    steady = receiver.steady if receiver else ()
    rates = [interval.bit_s for interval in steady]
    lasted_s = sum(interval.lasted_s for interval in steady)
    datagrams, lost = (_sum([getattr(interval, name) for interval in received]) for name in ("datagrams", "lost"))
    got = None if datagrams is None or lost is None else max(datagrams - lost, 0)
    values = {
        "iperf3_throughput_bit_s": 8 * sum(interval.payload_bytes for interval in steady) / lasted_s
        if steady
        else None,
        "iperf3_interval_min_bit_s": min(rates, default=None),
        "iperf3_interval_median_bit_s": median(rates) if rates else None,
        "iperf3_sent_bytes": sum(interval.payload_bytes for interval in sent) if sent else None,
        "iperf3_received_bytes": received_bytes,
        "iperf3_datagrams_sent": datagrams,
        "iperf3_datagrams_received": got,
        "iperf3_loss": 1 - got / datagrams if got is not None and datagrams else None,
        "iperf3_jitter_s": receiver.jitter_s if receiver else None,
        "iperf3_retransmits": _sum([interval.retransmits for interval in sent]),
    }
    foreign = _OF_TCP if protocol is Protocol.UDP else _OF_UDP
    own = {name: value for name, value in values.items() if name not in foreign}
    others = [column for column in COLUMNS if column.name in foreign]
    return Measured.of(own, "iperf3 does not say it") | Measured.nothing(others, f"{protocol} has none")


def _sum(counts: list[int | None]) -> int | None:
    known = [count for count in counts if count is not None]
    return sum(known) if known and len(known) == len(counts) else None
