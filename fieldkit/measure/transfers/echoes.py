"""What a capture at the end that pings holds of each echo: when the request left, and when the reply was whole."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from fieldkit.measure.captures.arrays import Ints
from fieldkit.measure.captures.ip import ICMP
from fieldkit.measure.captures.packets import ECHO_REPLY, NO_ECHO, Packets

HEADER_BYTES: Final = 8


@dataclass(frozen=True)
class CapturedPing:
    """The echoes of one identifier in one capture; times in nanoseconds since 1970 UTC, by sequence number.

    Attributes:
        requested_ns: First request with this number; of a fragmented one its first fragment.
        replied_ns: First reply that is whole: its last fragment.
    """

    requested_ns: Mapping[int, int]
    replied_ns: Mapping[int, int]


def of_each_ping(packets: Packets, asks: str, answers: str, payload_bytes: int) -> Iterator[CapturedPing]:
    """Yield the echoes of each identifier that has a request.

    Args:
        packets: A capture.
        asks: Address that the requests come from.
        answers: Address that they go to.
        payload_bytes: Payload of a request; echoes of another size are another ping's.
    """
    there, back = _icmp(packets, asks, answers), _icmp(packets, answers, asks)
    requests = there.where((there.echo != NO_ECHO) & (there.echo < ECHO_REPLY))
    requests = requests.where(_sizes(there, requests) == payload_bytes + HEADER_BYTES)
    replies = back.where(back.echo >= ECHO_REPLY)
    whole_ns = _whole_ns(back, replies, payload_bytes + HEADER_BYTES)
    for identifier in np.unique(requests.echo).tolist():
        own = requests.echo == identifier
        answered = (replies.echo == identifier + ECHO_REPLY) & (whole_ns >= 0)
        yield CapturedPing(
            _first(requests.echo_seq[own], requests.time_ns[own]),
            _first(replies.echo_seq[answered], whole_ns[answered]),
        )


def _icmp(packets: Packets, source: str, destination: str) -> Packets:
    return packets.where((packets.protocol == ICMP) & packets.are_from(source) & packets.are_to(destination))


def _sizes(packets: Packets, first: Packets) -> Ints:
    """Return the size of the datagram that each of these first fragments begins, as far as it was captured."""
    ends = packets.fragment_offset + packets.ip_payload_bytes
    order = np.lexsort((ends, packets.ip_id))
    ids, last = packets.ip_id[order], ends[order]
    alone = ~first.more_fragments
    # Of equal ids the largest end comes last.
    at = np.searchsorted(ids, first.ip_id, side="right") - 1
    return np.where(alone, first.ip_payload_bytes, last[at])


def _whole_ns(packets: Packets, first: Packets, size_bytes: int) -> Ints:
    """Return when each datagram was whole, by its first fragment; -1 if it never was, or has another size."""
    found = np.where(first.more_fragments, -1, np.where(first.ip_payload_bytes == size_bytes, first.time_ns, -1))
    for index in np.flatnonzero(first.more_fragments):
        parts = packets.where(packets.ip_id == first.ip_id[index])
        _, once = np.unique(parts.fragment_offset, return_index=True)
        if int(parts.ip_payload_bytes[once].sum()) == size_bytes:
            found[index] = parts.time_ns[once].max()
    return found


def _first(numbers: Ints, times_ns: Ints) -> dict[int, int]:
    """Return the earliest time of each number."""
    order = np.argsort(-times_ns, kind="stable")
    return dict(zip(numbers[order].tolist(), times_ns[order].tolist(), strict=True))
