"""Requests and replies of a ping that a robot received more than once, because copies arrived over several links.

The captures are on all interfaces (`LINUX_SLL2`), so each packet has the index of its interface.
"""

from collections import Counter
from collections.abc import Iterator
from typing import Final

import numpy as np

from fieldkit.core.columns import Figure, Kind, Measured, columns
from fieldkit.core.units import format_count
from fieldkit.measure.captures.arrays import Ints
from fieldkit.measure.captures.headers import NO_INTERFACE
from fieldkit.measure.captures.packets import ECHO_REPLY, NO_ECHO, Packets
from fieldkit.measure.evidence.ping import Ping

COLUMNS: Final = columns(
    110,
    (
        "rtt_duplicates",
        "count",
        (
            "Requests and replies of ping that arrived again over another link: for each packet, the number of "
            "interfaces on which it arrived, minus one. Empty without a capture on all interfaces of both robots, or "
            "if the requests are fragmented."
        ),
        Figure("duplicates over links", Kind.MEDIAN),
    ),
)

_UNREAD_S: Final = 0.1
_WAIT_SHARE: Final = 0.9
"""As in `ping_checks`: the part of the last interval in which ping certainly prints replies."""


def measure(requests: Packets | None, replies: Packets | None) -> Measured:
    """Return the column of the copies.

    Args:
        requests: Requests in the receiver's capture; None if it is missing or incomplete.
        replies: Replies in the sender's capture; None as above.
    """
    reason = ""
    if requests is None or replies is None:
        reason = "a robot has no complete capture around the ping"
    elif any((echoes.interface == NO_INTERFACE).any() for echoes in (requests, replies)):
        reason = "a capture does not contain interfaces: it needs a link with the interface lo, and tcpdump 4.99"
    elif any(echoes.more_fragments.any() for echoes in (requests, replies)):
        reason = "the requests are fragmented"
    if reason or requests is None or replies is None:
        return Measured.all_missing(COLUMNS, reason)
    return Measured({"rtt_duplicates": count_copies(requests) + count_copies(replies)})


def count_copies(echoes: Packets) -> int:
    """Return the sum over all packets of the number of interfaces on which a packet arrived, minus one."""
    rows = np.stack((_keys(echoes), echoes.interface))
    return len(np.unique(rows, axis=1).T) - len(np.unique(rows[0]))


def contradictions(
    output: Ping, interval_s: float, sender: tuple[Packets, Packets], receiver: tuple[Packets, Packets]
) -> Iterator[str]:
    """Yield the contradictions between the copies in the captures, the output of ping, and the answers.

    Args:
        output: The output.
        interval_s: Time between requests.
        sender: Requests and replies in the sender's capture.
        receiver: Requests and replies in the receiver's capture.
    """
    if any(echoes.more_fragments.any() for echoes in (*sender, *receiver)):
        return  # a copy may lack fragments
    sent, arrived = sender
    if len(sent):
        until_ns = int(sent.time_ns.max()) + round(1e9 * (_WAIT_SHARE * interval_s - _UNREAD_S))
        printed = Counter(reply.seq for reply in output.replies)
        captured = Counter(arrived.echo_seq[arrived.time_ns <= until_ns].tolist())
        unprinted = {seq: count for seq, count in (captured - printed).items() if printed[seq]}
        if unprinted:
            duplicates = format_count(sum(unprinted.values()), "duplicate")
            reply = f"the first to request {min(unprinted)}"
            yield f"the sender's capture has {duplicates} of replies that ping did not print, {reply}"
    requests, answers = receiver
    unrequested = Counter((_keys(answers) - (ECHO_REPLY << 16)).tolist()) - Counter(_keys(requests).tolist())
    if unrequested:
        answers_text = format_count(unrequested.total(), "answer")
        yield f"the receiver's capture has {answers_text} to requests that it lacks"


def sized_echoes(packets: Packets, source: str, destination: str, size_bytes: int | None) -> Packets:
    """Return the echoes from one address to another, of one ICMP size or fragmented."""
    echoes = packets.icmp(source, destination)
    has_size = echoes.more_fragments | (echoes.ip_payload_bytes == size_bytes)
    return echoes.where((echoes.echo != NO_ECHO) & has_size)


def _keys(echoes: Packets) -> Ints:
    """Return a number for the identifier and the sequence number of each echo."""
    return (echoes.echo << 16) | echoes.echo_seq
