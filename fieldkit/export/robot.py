"""Messages of an MCAP file from what the robots recorded in one attempt, each by its own clock."""

import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import LinkSample, Protocol, Role
from fieldkit.export import packets, schemas
from fieldkit.export.mcap import Channel, Json, Message
from fieldkit.export.packets import NOT_KNOWN, MarkedPackets
from fieldkit.export.schemas import Level
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.arrays import NO_TIME
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.captures.pcap import Capture
from fieldkit.measure.evidence import bag, ping
from fieldkit.measure.transfers import strangers
from fieldkit.measure.transfers.match import match
from fieldkit.trial.journal import Attempt
from fieldkit.trial.plan import Plan

# An IP packet's payload where no offload joined several: the MTU of Ethernet and Wi-Fi without the shortest header.
_LARGEST_PAYLOAD_BYTES: Final = 1480


@dataclass(frozen=True, eq=False)
class AttemptRecord:
    """What is left of an attempt; what is missing or unreadable is None or not there.

    Attributes:
        plan: The trial.
        attempt: Which.
        captures: What robots captured, of a damaged file what is before the damage.
        pings: What ping said.
        bags: What robots recorded.
        links: What their radios told of their links.
    """

    plan: Plan
    attempt: Attempt
    captures: Mapping[Role, Capture]
    pings: ping.Ping | None
    bags: Mapping[Role, bag.Bag]
    links: Mapping[Role, Sequence[LinkSample]]


def read(plan: Plan, attempt: Attempt, evidence: AttemptEvidence) -> AttemptRecord:
    """Return what is left of an attempt."""
    captures = {role: evidence.known(pcap.read, name) for role, name in plan.captures().items()}
    bags = {role: evidence.known(bag.read, name) for role, name in plan.bags().items()}
    return AttemptRecord(
        plan=plan,
        attempt=attempt,
        captures={role: one for role, one in captures.items() if one},
        pings=evidence.known(ping.read, plan.pinging.file) if plan.pinging else None,
        bags={role: one for role, one in bags.items() if one},
        links={role: evidence.links(role) for role in plan.cast},
    )


def flaws(found: AttemptRecord) -> Iterator[Json]:
    """Yield a line of the log for whatever of the evidence the messages do not tell."""

    def line(said: str, file: str) -> Json:
        name, t_ns = str(found.attempt.repeat), found.attempt.started_utc_ns
        return schemas.log(t_ns, Level.WARNING, said, name=name, file=f"repeats/{found.attempt.folder}/{file}")

    for role, capture in found.captures.items():
        if capture.damage:
            yield line(capture.damage, found.plan.captures()[role])
    untimed = sum(reply.at_utc_ns is None for reply in found.pings.replies) if found.pings else 0
    if untimed and found.plan.pinging:
        yield line(f"{untimed} replies have no time stamp and are left out", found.plan.pinging.file)


def messages(found: AttemptRecord) -> Iterator[Message]:
    """Return what sender and receiver recorded, in the order of their times as far as their clocks agree."""
    streams = []
    for role, seen in _seen(found).items():
        channel = _channel(
            found, role, "packets", schemas.PACKET, "What its capture holds: IP packets, frames of offload."
        )
        streams.append(packets.messages(channel, found.attempt.folder, seen))
    for role in found.plan.cast:
        short = [*_phases(found, role), *_links(found, role), *_rtts(found, role)]
        streams.append(iter(sorted(short, key=attrgetter("time_ns"))))
    return heapq.merge(*streams, key=attrgetter("time_ns"))


def _channel(found: AttemptRecord, role: Role, what: str, schema: Json, meaning: str) -> Channel:
    return Channel(f"/{role}/{what}", schema, f"{role} {found.plan.cast[role].name}", meaning)


def _rtts(found: AttemptRecord, role: Role) -> Iterator[Message]:
    """Yield the replies to ping that a robot printed, and the errors in place of one, when it did."""
    pinging = found.plan.pinging
    if pinging is None or found.pings is None or pinging.role != role:
        return
    repeat = found.attempt.folder
    channel = _channel(found, role, "rtt", schemas.RTT, "Each reply to ping, when it was printed.")
    for reply in found.pings.replies:
        if reply.at_utc_ns is not None:
            yield Message(channel, reply.at_utc_ns, schemas.rtt(reply.at_utc_ns, repeat, reply))
    log = _channel(found, role, "log", schemas.LOG, "ICMP errors in place of a reply to ping.")
    for problem in found.pings.problems:
        if problem.at_utc_ns is not None:
            said = f"icmp_seq={problem.seq}: {problem.source} says {problem.text}"
            yield Message(
                log,
                problem.at_utc_ns,
                schemas.log(problem.at_utc_ns, Level.WARNING, said, name=repeat, file=pinging.file),
            )


def _links(found: AttemptRecord, role: Role) -> Iterator[Message]:
    channel = _channel(found, role, "link", schemas.LINK, "What its radio told of its links, five times a second.")
    for sample in found.links[role]:
        yield Message(channel, sample.utc_ns, schemas.link(found.attempt.folder, sample))


def _phases(found: AttemptRecord, role: Role) -> Iterator[Message]:
    """Yield when a robot began to record, to send or receive, to ping, and when it ended."""
    channel = _channel(
        found, role, "phase", schemas.PHASE, "What it began to do, by the first and last stamp of its evidence."
    )
    for phase, begin_ns, end_ns in _spans(found, role):
        for t_ns, what in ((begin_ns, phase), (end_ns, "idle")):
            yield Message(channel, t_ns, schemas.phase(t_ns, found.attempt.folder, what))


def _spans(found: AttemptRecord, role: Role) -> Iterator[tuple[str, int, int]]:
    """Yield what a robot did, from when until when."""
    if recorded := found.bags.get(role):
        yield "record", recorded.started_utc_ns, recorded.started_utc_ns + round(recorded.duration_s * 1e9)
    transfer = found.plan.transfer(found.attempt.repeat.protocol)
    if transfer and role in found.captures:
        times_ns = transfer.forward(found.captures[role].packets).time_ns
        if len(times_ns) and times_ns.min() != NO_TIME:
            yield "transfer", int(times_ns.min()), int(times_ns.max())
    if found.pings and found.plan.pinging and found.plan.pinging.role == role:
        stamps_ns = [reply.at_utc_ns for reply in found.pings.replies if reply.at_utc_ns is not None]
        if stamps_ns:
            yield "ping", min(stamps_ns), max(stamps_ns)


def _seen(found: AttemptRecord) -> dict[Role, MarkedPackets]:
    fates = _fates(found)
    transfer = found.plan.transfer(found.attempt.repeat.protocol)
    called = {transfer.source: "lost", transfer.destination: "copy"} if transfer else {}
    return {
        role: MarkedPackets(one.packets, fates[role], called.get(role, "lost"))
        for role, one in found.captures.items()
    }


def _fates(found: AttemptRecord) -> dict[Role, NDArray[np.int8]]:
    """Return which of the transfer's packets were lost, and which are further copies; see `packets.MarkedPackets`."""
    fates = {role: np.full(len(one.packets), NOT_KNOWN, np.int8) for role, one in found.captures.items()}
    transfer = found.plan.transfer(found.attempt.repeat.protocol)
    if transfer is None or not {transfer.source, transfer.destination} <= fates.keys():
        return fates
    ends = [found.captures[role] for role in (transfer.source, transfer.destination)]
    if any(one.damage for one in ends):
        return fates
    sent, received = (one.packets for one in ends)
    if transfer.protocol is Protocol.TCP and (_is_offloaded(sent) or _is_offloaded(received)):
        return fates
    if strangers.reason(sent, received, transfer):
        return fates
    try:
        matched = match(sent, received)
    except EvidenceError:
        return fates
    in_doubt = np.append(matched.doubtful, False)[matched.sent_index]  # the last entry is that of match.NONE
    told = (
        (transfer.source, sent, ~matched.arrived, ~matched.doubtful),
        (transfer.destination, received, matched.duplicates, ~in_doubt),
    )
    for role, packets_of, is_so, is_sure in told:
        ours = packets_of.are_from(transfer.sender_address) & packets_of.are_to(transfer.receiver_address) & is_sure
        fates[role][ours] = is_so[ours]
    return fates


def _is_offloaded(captured: Packets) -> bool:
    """Return whether a capture has frames of several segments: those of one end are not those of the other."""
    return bool((captured.ip_payload_bytes > _LARGEST_PAYLOAD_BYTES).any())
