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


def flow_schedule(evidence: AttemptEvidence, transfer: Transfer, listener: str) -> FlowSchedule:
    """Return the known properties of a transfer; its sender always has more to send until the end of the file.

    Args:
        evidence: The attempt's evidence.
        transfer: The transfer.
        listener: Job that received the file; empty if unknown.
    """
    return FlowSchedule(
        size_bytes=evidence.read_or_none(reading.size, transfer.sent_file),
        until_ns=job_times.ended_ns(evidence, transfer.destination, listener),
    )


def read(evidence: AttemptEvidence, transfer: Transfer, listener: str) -> list[Delivery]:
    """Return the deliveries of each connection; arguments as for `flow_schedule`.

    Raises:
        EvidenceError: They cannot be determined from the captures.
    """
    sender, receiver = (evidence.whole_capture(file) for file in transfer.captures)
    if sender is None or receiver is None:
        raise EvidenceError("there are no complete captures of both ends")
    schedule = flow_schedule(evidence, transfer, listener)
    if transfer.protocol is Protocol.UDP:
        return of_udp(udp.match_transfer(sender.packets, receiver.packets, transfer), schedule)
    frames = tcp.match_transfer(sender.packets, receiver.packets, transfer)
    return of_tcp(frames, transfer.backward(sender.packets), schedule)


def of_udp(packets: UdpPackets, schedule: FlowSchedule) -> list[Delivery]:
    """Return the deliveries of a UDP transfer; errors as `deliveries.of_udp`."""
    return [deliveries.of_udp(packets, packets.is_transfer[:-1], schedule)]


def of_tcp(frames: TcpFrames, answers: Packets, schedule: FlowSchedule) -> list[Delivery]:
    """Return the deliveries of each connection of a TCP transfer; errors as `deliveries.of_tcp`.

    Args:
        frames: Frames of the connections in both captures.
        answers: Packets from receiver to sender in the sender's capture.
        schedule: Known properties of the transfer.
    """
    ports = np.unique(frames.sent.sport)
    if len(ports) == 1:
        return [deliveries.of_tcp(frames, answers.where(answers.dport == ports[0]), schedule)]
    return [
        deliveries.of_tcp(
            tcp.match_frames(
                frames.sent.where(frames.sent.sport == port), frames.received.where(frames.received.sport == port)
            ),
            answers.where(answers.dport == port),
            schedule,
        )
        for port in ports
    ]
