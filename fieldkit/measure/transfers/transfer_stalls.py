"""Deliveries of a file transfer, for its stalls and its recovery after a fault."""

import numpy as np

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol
from fieldkit.measure import job_times
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.evidence import reading
from fieldkit.measure.transfers import deliveries, tcp, udp
from fieldkit.measure.transfers.deliveries import Delivery, FlowSchedule
from fieldkit.measure.transfers.tcp import TcpFrames
from fieldkit.measure.transfers.transfer import Transfer
from fieldkit.measure.transfers.udp import UdpPackets


def expected(evidence: AttemptEvidence, transfer: Transfer, listener: str) -> FlowSchedule:
    """Return what is known of a transfer; its sender always has more to send, until the file ends.

    Args:
        evidence: What the attempt left.
        transfer: What was sent from where to where.
        listener: Job that received it; empty where that is not known.
    """
    return FlowSchedule(
        size_bytes=evidence.read_or_none(reading.size, transfer.sent_file),
        until_ns=job_times.ended_ns(evidence, transfer.destination, listener),
    )


def read(evidence: AttemptEvidence, transfer: Transfer, listener: str) -> list[Delivery]:
    """Return the deliveries of each connection; arguments as of `expected`.

    Raises:
        EvidenceError: The captures do not show them.
    """
    sender, receiver = (evidence.whole_capture(file) for file in transfer.captures)
    if sender is None or receiver is None:
        raise EvidenceError("there are no whole captures of both ends")
    known = expected(evidence, transfer, listener)
    if transfer.protocol is Protocol.UDP:
        return of_udp(udp.cross(sender.packets, receiver.packets, transfer), known)
    frames = tcp.cross(sender.packets, receiver.packets, transfer)
    return of_tcp(frames, transfer.backward(sender.packets), known)


def of_udp(crossing: UdpPackets, known: FlowSchedule) -> list[Delivery]:
    """Return the deliveries of a UDP transfer; errors as `deliveries.of_udp`."""
    return [deliveries.of_udp(crossing, crossing.ours[:-1], known)]


def of_tcp(frames: TcpFrames, answers: Packets, known: FlowSchedule) -> list[Delivery]:
    """Return the deliveries of each connection of a TCP transfer; errors as `deliveries.of_tcp`.

    Args:
        frames: Their frames in both captures.
        answers: Packets from receiver to sender in the sender's capture.
        known: What is known of the transfer.
    """
    ports = np.unique(frames.sent.sport)
    if len(ports) == 1:
        return [deliveries.of_tcp(frames, answers.where(answers.dport == ports[0]), known)]
    return [
        deliveries.of_tcp(
            tcp.beside(
                frames.sent.where(frames.sent.sport == port), frames.received.where(frames.received.sport == port)
            ),
            answers.where(answers.dport == port),
            known,
        )
        for port in ports
    ]
