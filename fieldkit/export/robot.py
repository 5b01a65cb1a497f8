"""MCAP messages from the robots' recordings of one attempt; each robot's times are by its clock."""

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
from fieldkit.measure.transfers.transfer_spec import Transfer
from fieldkit.trial.journal import Attempt
from fieldkit.trial.plan import Plan


@dataclass(frozen=True, eq=False)
class AttemptRecord:
    """The readable recordings of an attempt; missing or unreadable ones are left out.

    Attributes:
        plan: The trial.
        attempt: The attempt.
        captures: The captures by file; of a damaged capture the part before the damage.
        pings: The outputs of ping by file.
        bags: The recorded bags.
        links: The samples of the radios' links.
    """

    plan: Plan
    attempt: Attempt
    captures: Mapping[str, Capture]
    pings: Mapping[str, ping.Ping]
    bags: Mapping[Role, bag.Bag]
    links: Mapping[Role, Sequence[LinkSample]]

    @property
    def transfers(self) -> tuple[Transfer, ...]:
        """The packet filter of each of its transfers."""
        return self.plan.transfers(self.attempt.repeat.protocol)


def read(plan: Plan, attempt: Attempt, evidence: AttemptEvidence) -> AttemptRecord:
    """Return the readable recordings of an attempt."""
    captures = {name: evidence.read_or_none(pcap.read, name) for name in plan.captures()}
    pings = {pinging.file: evidence.read_or_none(ping.read, pinging.file) for pinging in plan.pingings()}
    bags = {role: evidence.read_or_none(bag.read, name) for role, name in plan.bags().items()}
    return AttemptRecord(
        plan=plan,
        attempt=attempt,
        captures={name: capture for name, capture in captures.items() if capture},
        pings={name: output for name, output in pings.items() if output},
        bags={role: content for role, content in bags.items() if content},
        links={role: evidence.links(role) for role in plan.cast},
    )


def flaws(record: AttemptRecord) -> Iterator[Json]:
    """Yield a log message for each part of the evidence that the other messages do not contain."""

    def line(text: str, file: str) -> Json:
        name, t_ns = str(record.attempt.repeat), record.attempt.started_utc_ns
        return schemas.log(t_ns, Level.WARNING, text, name=name, file=f"repeats/{record.attempt.folder}/{file}")

    for file, capture in record.captures.items():
        if capture.damage:
            yield line(capture.damage, file)
    for file, pings in record.pings.items():
        if untimed := sum(reply.at_utc_ns is None for reply in pings.replies):
            yield line(f"{untimed} replies have no time stamp and are left out", file)


def messages(record: AttemptRecord) -> Iterator[Message]:
    """Return the messages of the robots' recordings, in the order of their times as far as their clocks agree."""
    streams = []
    marked = fates.packet_fates(record.captures, record.transfers)
    for file, role in record.plan.captures().items():
        if file in record.captures:
            topic, meaning = (
                _named("packets", _step(file)),
                "What its capture holds: IP packets, frames of offload.",
            )
            channel = _channel(record, role, topic, schemas.PACKET, meaning)
            streams.append(packets.messages(channel, record.attempt.folder, marked[file]))
    for role in record.plan.cast:
        short = [*_phases(record, role), *_links(record, role), *_rtts(record, role)]
        streams.append(iter(sorted(short, key=attrgetter("time_ns"))))
    return heapq.merge(*streams, key=attrgetter("time_ns"))


def _channel(record: AttemptRecord, role: Role, topic: str, schema: Json, meaning: str) -> Channel:
    return Channel(f"/{role}/{topic}", schema, f"{role} {record.plan.cast[role].name}", meaning)


def _named(topic: str, step: str) -> str:
    """Return the name of a topic below that of its robot: `rtt`, or `rtt/busy` for a step with a name."""
    return f"{topic}/{step}" if step else topic


def _step(file: str) -> str:
    """Return the name of the step of a capture, empty if it has none."""
    return Path(file).stem.rpartition(".")[0]


def _rtts(record: AttemptRecord, role: Role) -> Iterator[Message]:
    """Yield the replies to ping that a robot printed, and ICMP errors, at the times of their output."""
    for pinging in record.plan.pingings():
        if pinging.role == role and pinging.file in record.pings:
            yield from _replies(record, role, pinging.name, pinging.file)


def _replies(record: AttemptRecord, role: Role, step: str, file: str) -> Iterator[Message]:
    repeat, pings = record.attempt.folder, record.pings[file]
    channel = _channel(record, role, _named("rtt", step), schemas.RTT, "Each reply to ping, when it was printed.")
    for reply in pings.replies:
        if reply.at_utc_ns is not None:
            yield Message(channel, reply.at_utc_ns, schemas.rtt(reply.at_utc_ns, repeat, reply))
    log = _channel(record, role, "log", schemas.LOG, "ICMP errors in place of a reply to ping.")
    for problem in pings.problems:
        if problem.at_utc_ns is not None:
            text = f"icmp_seq={problem.seq}: {problem.source} says {problem.text}"
            yield Message(
                log,
                problem.at_utc_ns,
                schemas.log(problem.at_utc_ns, Level.WARNING, text, name=repeat, file=file),
            )


def _links(record: AttemptRecord, role: Role) -> Iterator[Message]:
    channel = _channel(record, role, "link", schemas.LINK, "What its radio told of its links, five times a second.")
    for sample in record.links[role]:
        yield Message(channel, sample.utc_ns, schemas.link(record.attempt.folder, sample))


def _phases(record: AttemptRecord, role: Role) -> Iterator[Message]:
    """Yield when a robot started and stopped recording, sending or receiving, and ping; named steps are separate."""
    meaning = "What it began to do, by the first and last stamp of its evidence."
    for step, phase, begin_ns, end_ns in _spans(record, role):
        channel = _channel(record, role, _named("phase", step), schemas.PHASE, meaning)
        for t_ns, name in ((begin_ns, phase), (end_ns, "idle")):
            yield Message(channel, t_ns, schemas.phase(t_ns, record.attempt.folder, name))


def _spans(record: AttemptRecord, role: Role) -> Iterator[tuple[str, str, int, int]]:
    """Yield the phases of a robot: the step's name (empty if it has none), the phase, start and end."""
    if recorded := record.bags.get(role):
        yield "", "record", recorded.started_utc_ns, recorded.started_utc_ns + round(recorded.duration_s * 1e9)
    for transfer in record.transfers:
        for end, file in zip((transfer.source, transfer.destination), transfer.captures, strict=True):
            if end == role and file is not None and file in record.captures:
                forward = transfer.forward(record.captures[file].packets)
                # Other transfers may have the same direction at the same time as one with a name.
                times_ns = (forward.where(forward.dport == transfer.port) if transfer.name else forward).time_ns
                if len(times_ns) and times_ns.min() != NO_TIME:
                    yield transfer.name, "transfer", int(times_ns.min()), int(times_ns.max())
    for pinging in record.plan.pingings():
        if pinging.role == role and pinging.file in record.pings:
            replies = record.pings[pinging.file].replies
            stamps_ns = [reply.at_utc_ns for reply in replies if reply.at_utc_ns is not None]
            if stamps_ns:
                yield pinging.name, "ping", min(stamps_ns), max(stamps_ns)
