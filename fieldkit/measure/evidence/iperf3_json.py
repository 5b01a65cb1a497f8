"""Parts of iperf3's JSON: fields of a checked type, the parameters of the test (`start`) and its totals (`end`)."""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Final

_MAX_COUNT: Final = 2**53
"""Larger integers are not exact as a float."""
_VERSION: Final = re.compile(r"iperf (\d{1,4})\.(\d{1,4})")
_FIRST_WITH_THREADS: Final = (3, 16)
"""First version that has a thread per stream, according to its release notes."""


def mapping(document: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    """Return the object under a key, or an empty object if the value is not an object."""
    value = document.get(key)
    return value if isinstance(value, dict) else {}


def items(document: Mapping[str, Any], key: str) -> list[Mapping[str, Any]]:
    """Return the objects in the list under a key, or an empty list if the value is not a list."""
    value = document.get(key)
    return [item for item in value if isinstance(item, dict)] if isinstance(value, list) else []


def number(document: Mapping[str, Any], key: str) -> float | None:
    """Return the number under a key; None if it is missing, not a number, not finite, negative, or 2**53 or more."""
    value = document.get(key)
    is_in_range = isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < _MAX_COUNT
    return float(value) if is_in_range and value is not None and math.isfinite(value) else None


def count(document: Mapping[str, Any], key: str) -> int | None:
    """Return the number under a key, rounded down to an integer; None if `number` returns None."""
    value = number(document, key)
    return None if value is None else int(value)


@dataclass(frozen=True)
class IperfStart:
    """Parameters of a test. A parameter that the JSON does not contain is None or an empty string.

    Attributes:
        cookie: Random text that is the same at both ends of a test.
        start_utc_s: Start, in seconds since 1970 UTC.
        protocol: `tcp` or `udp`.
        streams: Number of parallel streams.
        block_bytes: Bytes per write; for UDP, the payload of a datagram.
        reverse: True if the server sends.
        has_threads: True from version 3.16 on, which has a thread per stream.
    """

    cookie: str = ""
    start_utc_s: int | None = None
    protocol: str = ""
    streams: int | None = None
    block_bytes: int | None = None
    reverse: bool | None = None
    has_threads: bool = False


@dataclass(frozen=True)
class IperfTotals:
    """Totals in `end`; None if unknown.

    A total of 0 bytes or datagrams, or a jitter of 0, counts as unknown, because some versions print 0 for unknown
    values.

    Attributes:
        sent_bytes: Payload sent.
        received_bytes: Payload received.
        datagrams: UDP datagrams that the receiver expected.
        lost: Expected datagrams that the receiver did not receive.
        jitter_s: Jitter at the receiver, in seconds.
        retransmits: Retransmitted segments.
        out_of_order: Number of datagrams in all streams that arrived out of order, including duplicates.
        summary_ends_s: End times in all summaries, in seconds from the start.
    """

    sent_bytes: int | None = None
    received_bytes: int | None = None
    datagrams: int | None = None
    lost: int | None = None
    jitter_s: float | None = None
    retransmits: int | None = None
    out_of_order: int = 0
    summary_ends_s: tuple[float, ...] = ()


def parse_start(document: Mapping[str, Any]) -> IperfStart:
    """Return the parameters of a test."""
    start = mapping(document, "start")
    test = mapping(start, "test_start")
    cookie, protocol, reverse = start.get("cookie"), test.get("protocol"), number(test, "reverse")
    version = _VERSION.match(str(start.get("version")))
    return IperfStart(
        cookie=cookie if isinstance(cookie, str) else "",
        start_utc_s=count(mapping(start, "timestamp"), "timesecs"),
        protocol=protocol.lower() if isinstance(protocol, str) else "",
        streams=count(test, "num_streams"),
        block_bytes=count(test, "blksize"),
        reverse=None if reverse is None else bool(reverse),
        has_threads=version is not None and (int(version[1]), int(version[2])) >= _FIRST_WITH_THREADS,
    )


def parse_totals(document: Mapping[str, Any]) -> IperfTotals:
    """Return the totals of a test."""
    end = mapping(document, "end")
    combined, sent, received = (mapping(end, name) for name in ("sum", "sum_sent", "sum_received"))
    udp_part = received if count(received, "packets") else combined
    return IperfTotals(
        sent_bytes=count(sent or combined, "bytes") or None,
        received_bytes=count(received, "bytes") or None,
        datagrams=count(udp_part, "packets") or None,
        lost=count(udp_part, "lost_packets") if count(udp_part, "packets") else None,
        jitter_s=next((ms / 1e3 for part in (received, combined) if (ms := number(part, "jitter_ms"))), None),
        retransmits=count(sent, "retransmits"),
        out_of_order=sum(count(mapping(stream, "udp"), "out_of_order") or 0 for stream in items(end, "streams")),
        summary_ends_s=tuple(_summary_ends_s(end)),
    )


def _summary_ends_s(end: Mapping[str, Any]) -> Iterator[float]:
    sums = [mapping(end, name) for name in ("sum", "sum_sent", "sum_received")]
    parts = [mapping(stream, name) for stream in items(end, "streams") for name in ("udp", "sender", "receiver")]
    yield from (end_s for part in (*sums, *parts) if (end_s := number(part, "end")) is not None)
