"""What the robots recorded in one attempt, each by its own clock, as messages of an MCAP file."""

import heapq
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import Protocol, Role
from fieldkit.export import packets, schemas
from fieldkit.export.mcap import Json, Message, Topic
from fieldkit.export.packets import NOT_KNOWN, Seen
from fieldkit.export.schemas import Level
from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.arrays import NO_TIME
from fieldkit.measure.captures.packets import Packets
from fieldkit.measure.captures.pcap import Capture
from fieldkit.measure.evidence import bag, ping, reading
from fieldkit.measure.evidence.reading import known
from fieldkit.measure.transfers.match import match
from fieldkit.trial.journal import Attempt
from fieldkit.trial.plan import Plan

_CAPTURES: Final = {Role.SENDER: reading.SENDER_CAPTURE, Role.RECEIVER: reading.RECEIVER_CAPTURE}
# An IP packet's payload where no offload joined several: the MTU of Ethernet and Wi-Fi without the shortest header.
_LARGEST_PAYLOAD_BYTES: Final = 1480


@dataclass(frozen=True, eq=False)
class Evidence:
    """What is left of an attempt; what is missing or unreadable is None or not there.

    Attributes:
        plan: The trial.
        attempt: Which.
        captures: What sender and receiver captured, of a damaged file what is before the damage.
        pings: What ping said.
        bags: What robots recorded.
    """

    plan: Plan
    attempt: Attempt
    captures: Mapping[Role, Capture]
    pings: ping.Ping | None
    bags: Mapping[Role, bag.Bag]


def read(plan: Plan, attempt: Attempt, folder: Path) -> Evidence:
    """Return what is left of an attempt in its `folder`."""
    captures = {role: known(pcap.read, folder / name) for role, name in _CAPTURES.items()}
    bags = {role: known(bag.read, folder / name) for role, name in plan.bags().items()}
    return Evidence(
        plan=plan,
        attempt=attempt,
        captures={role: one for role, one in captures.items() if one},
        pings=known(ping.read, folder / reading.PING),
        bags={role: one for role, one in bags.items() if one},
    )


def flaws(found: Evidence) -> Iterator[Json]:
    """Yield a line of the log for whatever of the evidence the messages do not tell."""

    def line(said: str, file: str) -> Json:
        name, t_ns = str(found.attempt.repeat), found.attempt.started_utc_ns
        return schemas.log(t_ns, Level.WARNING, said, name=name, file=f"repeats/{found.attempt.folder}/{file}")

    for role, capture in found.captures.items():
        if capture.damage:
            yield line(capture.damage, _CAPTURES[role])
    untimed = sum(reply.at_utc_ns is None for reply in found.pings.replies) if found.pings else 0
    if untimed:
        yield line(f"{untimed} replies have no time stamp and are left out", reading.PING)


def messages(found: Evidence) -> Iterator[Message]:
    """Return what sender and receiver recorded, in the order of their times as far as their clocks agree."""
    streams = []
    for role, seen in _seen(found).items():
        topic = _topic(
            found, role, "packets", schemas.PACKET, "What its capture holds: IP packets, frames of offload."
        )
        streams.append(packets.messages(topic, found.attempt.folder, seen))
    for role in found.plan.cast:
        short = [*_phases(found, role), *(_rtts(found) if role is found.plan.pinger else ())]
        streams.append(iter(sorted(short, key=attrgetter("time_ns"))))
    return heapq.merge(*streams, key=attrgetter("time_ns"))


def _topic(found: Evidence, role: Role, what: str, schema: Json, meaning: str) -> Topic:
    return Topic(f"/{role}/{what}", schema, f"{role} {found.plan.cast[role].name}", meaning)


def _rtts(found: Evidence) -> Iterator[Message]:
    """Yield the replies to ping, and the errors in place of one, when they were printed."""
    role = found.plan.pinger
    if role is None or found.pings is None:
        return
    repeat = found.attempt.folder
    topic = _topic(found, role, "rtt", schemas.RTT, "Each reply to ping, when it was printed.")
    for reply in found.pings.replies:
        if reply.at_utc_ns is not None:
            yield Message(topic, reply.at_utc_ns, schemas.rtt(reply.at_utc_ns, repeat, reply))
    log = _topic(found, role, "log", schemas.LOG, "ICMP errors in place of a reply to ping.")
    for problem in found.pings.problems:
        if problem.at_utc_ns is not None:
            said = f"icmp_seq={problem.seq}: {problem.source} says {problem.text}"
            yield Message(
                log,
                problem.at_utc_ns,
                schemas.log(problem.at_utc_ns, Level.WARNING, said, name=repeat, file=reading.PING),
            )


def _phases(found: Evidence, role: Role) -> Iterator[Message]:
    """Yield when a robot began to record, to send or receive, to ping, and when it ended."""
    topic = _topic(
        found, role, "phase", schemas.PHASE, "What it began to do, by the first and last stamp of its evidence."
    )
    for phase, begin_ns, end_ns in _spans(found, role):
        for t_ns, what in ((begin_ns, phase), (end_ns, "idle")):
            yield Message(topic, t_ns, schemas.phase(t_ns, found.attempt.folder, what))


def _spans(found: Evidence, role: Role) -> Iterator[tuple[str, int, int]]:
    """Yield what a robot did, from when until when."""
    if recorded := found.bags.get(role):
        yield "record", recorded.started_utc_ns, recorded.started_utc_ns + round(recorded.duration_s * 1e9)
    transfer = found.plan.transfer(found.attempt.repeat.protocol)
    if transfer and role in found.captures:
        times_ns = transfer.forward(found.captures[role].packets).time_ns
        if len(times_ns) and times_ns.min() != NO_TIME:
            yield "transfer", int(times_ns.min()), int(times_ns.max())
    if role is found.plan.pinger and found.pings:
        stamps_ns = [reply.at_utc_ns for reply in found.pings.replies if reply.at_utc_ns is not None]
        if stamps_ns:
            yield "ping", min(stamps_ns), max(stamps_ns)


def _seen(found: Evidence) -> dict[Role, Seen]:
    fates = _fates(found)
    called = {Role.SENDER: "lost", Role.RECEIVER: "copy"}
    return {role: Seen(one.packets, fates[role], called[role]) for role, one in found.captures.items()}


def _fates(found: Evidence) -> dict[Role, NDArray[np.int8]]:
    """Return which of the transfer's packets were lost, and which received are further copies; see `packets.Seen`."""
    fates = {role: np.full(len(one.packets), NOT_KNOWN, np.int8) for role, one in found.captures.items()}
    transfer = found.plan.transfer(found.attempt.repeat.protocol)
    if transfer is None or len(fates) < len(_CAPTURES) or any(one.damage for one in found.captures.values()):
        return fates
    captured = {role: one.packets for role, one in found.captures.items()}
    if transfer.protocol is Protocol.TCP and any(map(_is_offloaded, captured.values())):
        return fates
    try:
        matched = match(captured[Role.SENDER], captured[Role.RECEIVER])
    except EvidenceError:
        return fates
    for role, is_so in ((Role.SENDER, ~matched.arrived), (Role.RECEIVER, matched.duplicates)):
        ours = captured[role].are_from(transfer.sender_address) & captured[role].are_to(transfer.receiver_address)
        fates[role][ours] = is_so[ours]
    return fates


def _is_offloaded(captured: Packets) -> bool:
    """Return whether a capture has frames of several segments: those of one end are not those of the other."""
    return bool((captured.ip_payload_bytes > _LARGEST_PAYLOAD_BYTES).any())
