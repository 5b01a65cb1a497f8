"""Messages of an MCAP file from what the robots recorded in one attempt, each by its own clock."""

import heapq
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path

from fieldkit.core.model import LinkSample, Role
from fieldkit.export import fates, packets, schemas
from fieldkit.export.mcap import Channel, Json, Message
from fieldkit.export.schemas import Level
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.arrays import NO_TIME
from fieldkit.measure.captures.pcap import Capture
from fieldkit.measure.evidence import bag, ping
from fieldkit.measure.transfers.transfer import Transfer
from fieldkit.trial.journal import Attempt
from fieldkit.trial.plan import Plan


@dataclass(frozen=True, eq=False)
class AttemptRecord:
    """What is left of an attempt; what is missing or unreadable is not there.

    Attributes:
        plan: The trial.
        attempt: Which.
        captures: What robots captured, by file, of a damaged one what is before the damage.
        pings: What ping said, by file.
        bags: What robots recorded.
        links: What their radios told of their links.
    """

    plan: Plan
    attempt: Attempt
    captures: Mapping[str, Capture]
    pings: Mapping[str, ping.Ping]
    bags: Mapping[Role, bag.Bag]
    links: Mapping[Role, Sequence[LinkSample]]

    @property
    def transfers(self) -> tuple[Transfer, ...]:
        """What tells the packets of each of its transfers."""
        return self.plan.transfers(self.attempt.repeat.protocol)


def read(plan: Plan, attempt: Attempt, evidence: AttemptEvidence) -> AttemptRecord:
    """Return what is left of an attempt."""
    captures = {name: evidence.read_or_none(pcap.read, name) for name in plan.captures()}
    pings = {pinging.file: evidence.read_or_none(ping.read, pinging.file) for pinging in plan.pingings()}
    bags = {role: evidence.read_or_none(bag.read, name) for role, name in plan.bags().items()}
    return AttemptRecord(
        plan=plan,
        attempt=attempt,
        captures={name: capture for name, capture in captures.items() if capture},
        pings={name: one for name, one in pings.items() if one},
        bags={role: one for role, one in bags.items() if one},
        links={role: evidence.links(role) for role in plan.cast},
    )


def flaws(found: AttemptRecord) -> Iterator[Json]:
    """Yield a line of the log for whatever of the evidence the messages do not tell."""

    def line(said: str, file: str) -> Json:
        name, t_ns = str(found.attempt.repeat), found.attempt.started_utc_ns
        return schemas.log(t_ns, Level.WARNING, said, name=name, file=f"repeats/{found.attempt.folder}/{file}")

    for file, capture in found.captures.items():
        if capture.damage:
            yield line(capture.damage, file)
    for file, pings in found.pings.items():
        if untimed := sum(reply.at_utc_ns is None for reply in pings.replies):
            yield line(f"{untimed} replies have no time stamp and are left out", file)


def messages(found: AttemptRecord) -> Iterator[Message]:
    """Return what the robots recorded, in the order of their times as far as their clocks agree."""
    streams = []
    told = fates.told(found.captures, found.transfers)
    for file, role in found.plan.captures().items():
        if file in found.captures:
            what, meaning = _named("packets", _step(file)), "What its capture holds: IP packets, frames of offload."
            channel = _channel(found, role, what, schemas.PACKET, meaning)
            streams.append(packets.messages(channel, found.attempt.folder, told[file]))
    for role in found.plan.cast:
        short = [*_phases(found, role), *_links(found, role), *_rtts(found, role)]
        streams.append(iter(sorted(short, key=attrgetter("time_ns"))))
    return heapq.merge(*streams, key=attrgetter("time_ns"))


def _channel(found: AttemptRecord, role: Role, what: str, schema: Json, meaning: str) -> Channel:
    return Channel(f"/{role}/{what}", schema, f"{role} {found.plan.cast[role].name}", meaning)


def _named(what: str, step: str) -> str:
    """Return what a topic is called below its robot's: `rtt`, of a step that has a name `rtt/busy`."""
    return f"{what}/{step}" if step else what


def _step(file: str) -> str:
    """Return the name of the step that a capture is of, empty where that has none."""
    return Path(file).stem.rpartition(".")[0]


def _rtts(found: AttemptRecord, role: Role) -> Iterator[Message]:
    """Yield the replies to ping that a robot printed, and the errors in place of one, when it did."""
    for pinging in found.plan.pingings():
        if pinging.role == role and pinging.file in found.pings:
            yield from _replies(found, role, pinging.name, pinging.file)


def _replies(found: AttemptRecord, role: Role, step: str, file: str) -> Iterator[Message]:
    repeat, pings = found.attempt.folder, found.pings[file]
    channel = _channel(found, role, _named("rtt", step), schemas.RTT, "Each reply to ping, when it was printed.")
    for reply in pings.replies:
        if reply.at_utc_ns is not None:
            yield Message(channel, reply.at_utc_ns, schemas.rtt(reply.at_utc_ns, repeat, reply))
    log = _channel(found, role, "log", schemas.LOG, "ICMP errors in place of a reply to ping.")
    for problem in pings.problems:
        if problem.at_utc_ns is not None:
            said = f"icmp_seq={problem.seq}: {problem.source} says {problem.text}"
            yield Message(
                log,
                problem.at_utc_ns,
                schemas.log(problem.at_utc_ns, Level.WARNING, said, name=repeat, file=file),
            )


def _links(found: AttemptRecord, role: Role) -> Iterator[Message]:
    channel = _channel(found, role, "link", schemas.LINK, "What its radio told of its links, five times a second.")
    for sample in found.links[role]:
        yield Message(channel, sample.utc_ns, schemas.link(found.attempt.folder, sample))


def _phases(found: AttemptRecord, role: Role) -> Iterator[Message]:
    """Yield when a robot began to record, to send or receive, to ping, and when it ended; a named step by itself."""
    meaning = "What it began to do, by the first and last stamp of its evidence."
    for step, phase, begin_ns, end_ns in _spans(found, role):
        channel = _channel(found, role, _named("phase", step), schemas.PHASE, meaning)
        for t_ns, what in ((begin_ns, phase), (end_ns, "idle")):
            yield Message(channel, t_ns, schemas.phase(t_ns, found.attempt.folder, what))


def _spans(found: AttemptRecord, role: Role) -> Iterator[tuple[str, str, int, int]]:
    """Yield what a robot did: the name of the step, empty where it has none, the phase, from when until when."""
    if recorded := found.bags.get(role):
        yield "", "record", recorded.started_utc_ns, recorded.started_utc_ns + round(recorded.duration_s * 1e9)
    for transfer in found.transfers:
        for end, file in zip((transfer.source, transfer.destination), transfer.captures, strict=True):
            if end == role and file is not None and file in found.captures:
                forward = transfer.forward(found.captures[file].packets)
                # Others may go the same way beside one that has a name.
                times_ns = (forward.where(forward.dport == transfer.port) if transfer.name else forward).time_ns
                if len(times_ns) and times_ns.min() != NO_TIME:
                    yield transfer.name, "transfer", int(times_ns.min()), int(times_ns.max())
    for pinging in found.plan.pingings():
        if pinging.role == role and pinging.file in found.pings:
            replies = found.pings[pinging.file].replies
            stamps_ns = [reply.at_utc_ns for reply in replies if reply.at_utc_ns is not None]
            if stamps_ns:
                yield pinging.name, "ping", min(stamps_ns), max(stamps_ns)
