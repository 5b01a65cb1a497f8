"""Pings in a capture of the pinging robot: times of echo requests and of complete replies."""

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
    """Echoes of one ICMP identifier in one capture; times in nanoseconds since 1970 UTC, by sequence number.

    Attributes:
        requested_ns: Time of the first request; if fragmented, of its first fragment.
        replied_ns: Time of the first complete reply; if fragmented, of its last fragment.
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
    outgoing, returning = _icmp(packets, source, destination), _icmp(packets, destination, source)
    requests = outgoing.where((outgoing.echo != NO_ECHO) & (outgoing.echo < ECHO_REPLY))
    requests = requests.where(_sizes(outgoing, requests) == payload_bytes + HEADER_BYTES)
    replies = returning.where(returning.echo >= ECHO_REPLY)
    complete_ns = _complete_ns(returning, replies, payload_bytes + HEADER_BYTES)
    for identifier in np.unique(requests.echo).tolist():
        matches = requests.echo == identifier
        answered = (replies.echo == identifier + ECHO_REPLY) & (complete_ns >= 0)
        yield CapturedPing(
            _first(requests.echo_seq[matches], requests.time_ns[matches]),
            _first(replies.echo_seq[answered], complete_ns[answered]),
        )


def _icmp(packets: Packets, source: str, destination: str) -> Packets:
    return packets.where((packets.protocol == ICMP) & packets.are_from(source) & packets.are_to(destination))


def _sizes(packets: Packets, first: Packets) -> Ints:
    """Return the captured size of the datagram that starts with each of these first fragments."""
    ends = packets.fragment_offset + packets.ip_payload_bytes
    order = np.lexsort((ends, packets.ip_id))
    ids, last = packets.ip_id[order], ends[order]
    unfragmented = ~first.more_fragments
    # Among equal ids the largest end is last.
    at = np.searchsorted(ids, first.ip_id, side="right") - 1
    return np.where(unfragmented, first.ip_payload_bytes, last[at])


def _complete_ns(packets: Packets, first: Packets, size_bytes: int) -> Ints:
    """Return the time at which each datagram was complete; -1 if it never was, or has another size."""
    times_ns = np.where(first.more_fragments, -1, np.where(first.ip_payload_bytes == size_bytes, first.time_ns, -1))
    for index in np.flatnonzero(first.more_fragments):
        parts = packets.where(packets.ip_id == first.ip_id[index])
        _, unique_parts = np.unique(parts.fragment_offset, return_index=True)
        if int(parts.ip_payload_bytes[unique_parts].sum()) == size_bytes:
            times_ns[index] = parts.time_ns[unique_parts].max()
    return times_ns


def _first(numbers: Ints, times_ns: Ints) -> dict[int, int]:
    """Return the earliest time of each number."""
    order = np.argsort(-times_ns, kind="stable")
    return dict(zip(numbers[order].tolist(), times_ns[order].tolist(), strict=True))
