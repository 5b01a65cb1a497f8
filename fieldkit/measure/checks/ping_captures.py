"""Comparison of the output of ping with captures of its echoes on both robots."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from fieldkit.core.model import Role
from fieldkit.core.units import format_count
from fieldkit.measure.captures.arrays import NO_TIME, Mask
from fieldkit.measure.captures.packets import ECHO_REPLY, NO_ECHO, Packets
from fieldkit.measure.captures.pcap import Capture
from fieldkit.measure.checks import ping_checks
from fieldkit.measure.evidence.ping import Ping

if TYPE_CHECKING:
    from fieldkit.measure.checks.ping_duplicates import PingEchoes

_HEADER_BYTES: Final = 8
"""Length of the ICMP header of an echo (RFC 792)."""


@dataclass(frozen=True)
class PingCaptures:
    """Captures that started before a ping and ended after it.

    Attributes:
        file: Name of the file with the output of ping, for messages.
        sender: Role of the robot that sends the requests.
        by_role: Captures by role, first the sender's and then the receiver's; None if a robot did not capture, or if
            its capture is incomplete.
        source: Source address of the requests.
        destination: Their destination address.
    """

    file: str
    sender: Role
    by_role: Mapping[Role, Capture | None]
    source: str
    destination: str

    def echoes(self, payload_bytes: int) -> "tuple[PingEchoes | None, ...]":
        """Return the echoes with this payload in each capture; None for a missing or incomplete capture."""
        from fieldkit.measure.checks.ping_duplicates import captured_echoes  # noqa: PLC0415 (only with several links)

        size_bytes = payload_bytes + _HEADER_BYTES
        captures = self.by_role.values()
        return tuple(captured_echoes(capture, self.source, self.destination, size_bytes) for capture in captures)

    def find_problems(self, result: Ping, interval_s: float) -> Iterator[str]:
        """Yield each reason why the captures contradict the output of ping.

        Args:
            result: Parsed output of ping.
            interval_s: Time between requests.
        """
        missing_packets = [reason for role in self.by_role for reason in self._missing_packets(result, role)]
        yield from missing_packets or self._contradictions(result, interval_s)
        # If the captures lack packets of this ping, the origin of other packets cannot be determined.
        if not missing_packets and (earlier_count := self._count_earlier_packets()):
            packets_text = format_count(earlier_count, "packet")
            yield (
                f"packets of an earlier attempt were still in transit: {packets_text} of a ping that sent no request "
                "in this attempt arrived"
            )

    def _missing_packets(self, result: Ping, role: Role) -> Iterator[str]:
        """Yield a reason if ping printed more replies, or more answered requests, than a capture contains.

        Replies include duplicates and damaged replies.

        The capture may contain other pings, with other identifiers or sizes. The printed number is compared with
        the packet count of the most frequent identifier, so the identifier of this ping need not be known.
        """
        capture = self.by_role[role]
        if capture is None:
            return
        packets = capture.packets
        echoes = packets.where((packets.echo != NO_ECHO) & _has_payload(packets, result.payload_bytes))
        counts = (
            (len(result.replies), "answer", _max_count(echoes.icmp(self.destination, self.source))),
            (len(result.answers), "answered request", _max_count(echoes.icmp(self.source, self.destination))),
        )
        for printed_count, kind, captured_count in counts:
            if printed_count > captured_count:
                printed_text = format_count(printed_count, kind)
                yield f"{self.file} has {printed_text}, but the {role}'s capture has only {captured_count}"
                return

    def _contradictions(self, result: Ping, interval_s: float) -> Iterator[str]:
        """Yield the contradictions between the output and each capture.

        If several pings ran, the ping with the fewest contradictions is assumed to be this one.
        """
        for role, capture in self.by_role.items():
            if capture is None or result.payload_bytes is None or (capture.packets.time_ns == NO_TIME).any():
                continue
            candidates = ping_checks.captured_pings(
                capture.packets, self.source, self.destination, result.payload_bytes
            )
            is_sender = role == self.sender
            reasons = [
                list(ping_checks.compare_with_capture(result, candidate, interval_s, role, is_requester=is_sender))
                for candidate in candidates
            ]
            yield from (f"{self.file}: {reason}" for reason in min(reasons, key=len, default=[]))

    def _count_earlier_packets(self) -> int:
        """Return the number of received packets of pings that sent no request during the captures.

        Packets of another ping of this attempt do not count, because its requests were captured. Later fragments
        whose first fragment is missing are counted only for requests: the sender's capture contains all requests of
        this attempt, because it ends after the ping. The receiver's capture may lack late replies, so fragments of
        replies cannot be attributed.
        """
        sender, receiver = self.by_role.values()
        if sender is None or receiver is None:
            return 0
        requests, arrivals = (capture.packets.icmp(self.source, self.destination) for capture in (sender, receiver))
        replies = sender.packets.icmp(self.destination, self.source)
        # `echo` is the identifier of a ping process; in replies, `ECHO_REPLY` is added to it.
        is_request = (arrivals.echo != NO_ECHO) & (arrivals.echo < ECHO_REPLY)
        was_sent = np.isin(arrivals.echo, requests.echo)
        earlier_count = int((is_request & ~was_sent).sum())
        is_earlier_reply = (replies.echo >= ECHO_REPLY) & ~np.isin(replies.echo - ECHO_REPLY, requests.echo)
        earlier_count += int(is_earlier_reply.sum())
        # Fragments are identified by their IP ids, unless a router has changed these.
        if np.isin(arrivals.ip_id[is_request & was_sent], requests.ip_id).all():
            is_earlier_fragment = (arrivals.fragment_offset > 0) & ~np.isin(arrivals.ip_id, requests.ip_id)
            earlier_count += int(is_earlier_fragment.sum())
        return earlier_count


def _has_payload(packets: Packets, payload_bytes: int | None) -> Mask:
    """Return a mask of the packets that can be echoes with this payload: unfragmented packets and first fragments."""
    if payload_bytes is None:
        return np.ones(len(packets), dtype=np.bool_)
    size = payload_bytes + _HEADER_BYTES
    mask: Mask = np.where(packets.more_fragments, packets.ip_payload_bytes < size, packets.ip_payload_bytes == size)
    return mask


def _max_count(echoes: Packets) -> int:
    """Return the number of packets of the identifier with the most packets; 0 without packets."""
    _, counts = np.unique(echoes.echo, return_counts=True)
    return int(counts.max(initial=0))
