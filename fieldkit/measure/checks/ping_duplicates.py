"""Requests and replies of a ping that a robot received more than once, because copies arrived over several links.

The captures are on all interfaces (`LINUX_SLL2`), so each packet has the index of its interface.
"""

from collections import Counter
from collections.abc import Iterator
from typing import Final, NamedTuple

import numpy as np

from fieldkit.core.columns import Figure, Kind, Measured, columns
from fieldkit.core.units import format_count
from fieldkit.measure.captures.arrays import Ints
from fieldkit.measure.captures.headers import NO_INTERFACE
from fieldkit.measure.captures.packets import ECHO_REPLY, NO_ECHO, Packets
from fieldkit.measure.captures.pcap import Capture
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
"""ping certainly prints the replies that arrive within this share of an interval, minus `_UNREAD_S`, after the last
request. `ping_checks` uses the same limits."""


class PingEchoes(NamedTuple):
    """ICMP echoes of one ping in one capture.

    Attributes:
        requests: Its requests.
        replies: The replies to them.
    """

    requests: Packets
    replies: Packets

    @property
    def are_fragmented(self) -> bool:
        """True if any echo is fragmented."""
        return bool(self.requests.more_fragments.any() or self.replies.more_fragments.any())


def captured_echoes(capture: Capture | None, source: str, destination: str, size_bytes: int) -> PingEchoes | None:
    """Return the echoes between two addresses in a capture; None without a capture.

    Args:
        capture: The capture; None if it is missing.
        source: Source address of the requests.
        destination: Their destination address.
        size_bytes: Length of an echo with its ICMP header; echoes of another length belong to another ping.
    """
    if capture is None:
        return None
    outgoing, returning = capture.packets.icmp(source, destination), capture.packets.icmp(destination, source)
    requests = outgoing.where((outgoing.echo != NO_ECHO) & (outgoing.echo < ECHO_REPLY))
    replies = returning.where(returning.echo >= ECHO_REPLY)
    return PingEchoes(_sized(requests, size_bytes), _sized(replies, size_bytes))


def _sized(echoes: Packets, size_bytes: int) -> Packets:
    """Return the unfragmented echoes of this length, and the first fragments of fragmented echoes."""
    return echoes.where(echoes.more_fragments | (echoes.ip_payload_bytes == size_bytes))


def measure(sender: PingEchoes | None, receiver: PingEchoes | None) -> Measured:
    """Return the column `rtt_duplicates`.

    Args:
        sender: Echoes in the sender's capture; None if the capture is missing or incomplete.
        receiver: Echoes in the receiver's capture; None if the capture is missing or incomplete.
    """
    echoes = echoes_by_interface(sender, receiver)
    if isinstance(echoes, str):
        return Measured.all_missing(COLUMNS, echoes)
    at_sender, at_receiver = echoes
    return Measured({"rtt_duplicates": count_copies(at_receiver.requests) + count_copies(at_sender.replies)})


def echoes_by_interface(
    sender: PingEchoes | None, receiver: PingEchoes | None
) -> tuple[PingEchoes, PingEchoes] | str:
    """Return both arguments, or the reason why they do not show over which interface each echo was captured."""
    if sender is None or receiver is None:
        return "a robot has no complete capture around the ping"
    if sender.are_fragmented or receiver.are_fragmented:
        return "the requests are fragmented"
    if any((echoes.interface == NO_INTERFACE).any() for echoes in (*sender, *receiver)):
        return (
            "a capture does not contain the interface of each packet: ping over a link with the interface lo, and "
            "use tcpdump 4.99 or later"
        )
    return sender, receiver


def count_copies(echoes: Packets) -> int:
    """Return the number of copies: for each packet, the number of interfaces on which it arrived, minus one."""
    rows = np.stack((echo_keys(echoes), echoes.interface))
    return len(np.unique(rows, axis=1).T) - len(np.unique(rows[0]))


def echo_keys(echoes: Packets) -> Ints:
    """Return a number for each echo that combines its identifier and its sequence number."""
    return (echoes.echo << 16) | echoes.echo_seq


def contradictions(
    output: Ping, interval_s: float, sender: PingEchoes | None, receiver: PingEchoes | None
) -> Iterator[str]:
    """Yield the contradictions between the captured copies and the output of ping, and between requests and answers.

    Args:
        output: Parsed output of ping.
        interval_s: Time between requests.
        sender: Echoes in the sender's capture; None if the capture is missing or incomplete.
        receiver: Echoes in the receiver's capture; None if the capture is missing or incomplete.
    """
    if sender is None or receiver is None or sender.are_fragmented or receiver.are_fragmented:
        return  # a copy of a fragmented echo may be incomplete
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
    unrequested = Counter((echo_keys(answers) - (ECHO_REPLY << 16)).tolist()) - Counter(echo_keys(requests).tolist())
    if unrequested:
        answers_text = format_count(unrequested.total(), "answer")
        yield f"the receiver's capture has {answers_text} to requests that it does not contain"
    if missing_seqs := {reply.seq for reply in output.answers}.difference(requests.echo_seq.tolist()):
        requests_text = format_count(len(missing_seqs), "answered request")
        yield f"the receiver's capture does not contain {requests_text}, the first is request {min(missing_seqs)}"
