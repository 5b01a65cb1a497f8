"""MCAP messages from the robots' recordings of one attempt. Times are by the clock of the recording robot.

Each packet of a capture is a message. It contains the packet's fate if this is known: whether the packet was lost, or
is a copy of another one.
"""

import heapq
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from fieldkit.core.errors import EvidenceError
from fieldkit.core.model import LinkSample, Protocol, Role
from fieldkit.export import schemas
from fieldkit.export.mcap import Channel, Json, Message
from fieldkit.export.schemas import Level, time
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.captures import pcap
from fieldkit.measure.captures.arrays import NO_TIME
from fieldkit.measure.captures.headers import address_text
from fieldkit.measure.captures.packets import NO_PORT, Packets
from fieldkit.measure.captures.pcap import Capture
from fieldkit.measure.evidence import ping, recordings
from fieldkit.measure.evidence.recordings import RecordingContents
from fieldkit.measure.transfers import altered_packets
from fieldkit.measure.transfers.match import Match, match
from fieldkit.measure.transfers.transfer_spec import Transfer
from fieldkit.telemetry import telemetry_samples
from fieldkit.telemetry.telemetry_samples import TelemetrySample
from fieldkit.trial import planned_evidence
from fieldkit.trial.journal import Attempt
from fieldkit.trial.plan import Plan

UNKNOWN_FATE: Final = -1
"""Value of `lost` and `copy` for packets whose fate is unknown."""
_SLICE: Final = 1 << 14
"""Number of packets that are converted to Python objects at a time."""

# Fields of a message by the values of `MarkedPackets`: index -1 (UNKNOWN_FATE) is the last, empty element.
_LOST: Final[tuple[dict[str, bool], ...]] = ({"lost": False}, {"lost": True}, {})
_COPY: Final[tuple[dict[str, bool], ...]] = ({"copy": False}, {"copy": True}, {})


@dataclass(frozen=True, eq=False)
class MarkedPackets:
    """The packets captured by one robot, with their fates.

    Attributes:
        packets: The packets in the order of the file.
        lost: 1 for a sent packet that was lost, 0 for one that arrived, otherwise `UNKNOWN_FATE`. Shape (n,).
        copy: 1 for a received packet that is a duplicate, 0 for other received packets, otherwise `UNKNOWN_FATE`.
            Shape (n,).
    """

    packets: Packets
    lost: NDArray[np.int8]
    copy: NDArray[np.int8]


def packet_messages(channel: Channel, repeat: str, captured: MarkedPackets) -> Iterator[Message]:
    """Yield a message for each packet with a known time, in the order of time.

    Args:
        channel: The channel.
        repeat: Name of the repeat's folder.
        captured: The packets.
    """
    time_ns = captured.packets.time_ns
    order = np.argsort(time_ns, kind="stable")
    order = order[time_ns[order] != NO_TIME]
    for start in range(0, len(order), _SLICE):
        indices = order[start : start + _SLICE]
        packets = captured.packets.where(indices)
        fates = (captured.lost[indices].tolist(), captured.copy[indices].tolist())
        for t_ns, fields, lost, copy in zip(packets.time_ns.tolist(), _contents(packets), *fates, strict=True):
            fate = _LOST[lost] | _COPY[copy]
            yield Message(channel, t_ns, {"timestamp": time(t_ns), "repeat": repeat} | fields | fate)


def _contents(packets: Packets) -> Iterator[dict[str, object]]:
    """Yield the header fields of each packet."""
    columns = {
        "protocol": packets.protocol.tolist(),
        "source": [address_text(*halves) for halves in packets.src.tolist()],
        "destination": [address_text(*halves) for halves in packets.dst.tolist()],
        "source_port": packets.sport.tolist(),
        "destination_port": packets.dport.tolist(),
        "wire_bytes": packets.wire_bytes.tolist(),
        "payload_bytes": packets.ip_payload_bytes.tolist(),
        "fragment_offset": packets.fragment_offset.tolist(),
    }
    for values in zip(*columns.values(), strict=True):
        yield {name: value for name, value in zip(columns, values, strict=True) if value != NO_PORT}


# Largest IP payload of a frame that offload did not join: the MTU of Ethernet and Wi-Fi minus the shortest header of
# IPv4.
_LARGEST_PAYLOAD_BYTES: Final = 1480


def packet_fates(captures: Mapping[str, Capture], transfers: Iterable[Transfer]) -> Mapping[str, MarkedPackets]:
    """Return the packets of each capture, with their fates.

    A fate is known only if the packet belongs to a transfer that both its sender and its receiver captured, if these
    captures can be matched, and if the match of the packet is not ambiguous.

    Args:
        captures: The captures by file.
        transfers: The transfers, which identify their packets.
    """
    marked = {file: _with_unknown_fates(capture.packets) for file, capture in captures.items()}
    transfers_by_path: dict[tuple[str, str, str, str], list[Transfer]] = {}
    for transfer in transfers:
        sender_file, receiver_file = transfer.captures
        if sender_file is not None and receiver_file is not None and {sender_file, receiver_file} <= captures.keys():
            transfers_by_path.setdefault(
                (sender_file, receiver_file, transfer.sender_address, transfer.receiver_address), []
            ).append(transfer)
    for (sender_file, receiver_file, sender, receiver), same_path in transfers_by_path.items():
        matched = _match_captures(captures[sender_file], captures[receiver_file], same_path)
        if matched is None:
            continue
        sent, received = marked[sender_file], marked[receiver_file]
        forward = sent.packets.are_from(sender) & sent.packets.are_to(receiver) & ~matched.ambiguous
        sent.lost[forward] = ~matched.arrived[forward]
        # `match.NONE` (-1), for a packet that is not in the sender's capture, selects the appended False.
        is_ambiguous = np.append(matched.ambiguous, False)[matched.sent_index]
        forward = received.packets.are_from(sender) & received.packets.are_to(receiver) & ~is_ambiguous
        received.copy[forward] = matched.duplicates[forward]
    return marked


def _with_unknown_fates(packets: Packets) -> MarkedPackets:
    lost, copy = np.full((2, len(packets)), UNKNOWN_FATE, np.int8)
    return MarkedPackets(packets, lost, copy)


def _match_captures(sender: Capture, receiver: Capture, same_path: Sequence[Transfer]) -> Match | None:
    """Match the packets of two captures. Return None if the packets of a transfer on this path cannot be matched."""
    sent, received = sender.packets, receiver.packets
    if sender.damage or receiver.damage:
        return None
    is_tcp = any(transfer.protocol is Protocol.TCP for transfer in same_path)
    if is_tcp and (_is_offloaded(sent) or _is_offloaded(received)):
        return None
    if any(altered_packets.incomparability_reason(sent, received, transfer) for transfer in same_path):
        return None
    try:
        return match(sent, received)
    except EvidenceError:
        return None


def _is_offloaded(captured: Packets) -> bool:
    """Return True if a capture has frames of several segments. Such frames differ between sender and receiver."""
    return bool((captured.ip_payload_bytes > _LARGEST_PAYLOAD_BYTES).any())


@dataclass(frozen=True, eq=False)
class AttemptRecord:
    """The readable recordings of an attempt. Missing or unreadable recordings are omitted.

    Attributes:
        plan: The trial.
        attempt: The attempt.
        captures: Captures by file; a damaged capture contains the packets before the damage.
        pings: Outputs of ping by file.
        bags: Contents of the recorded bags by role.
        links: Samples of the radios' links by role.
        telemetry: Values of the telemetry sources that robots queried, by role.
    """

    plan: Plan
    attempt: Attempt
    captures: Mapping[str, Capture]
    pings: Mapping[str, ping.Ping]
    bags: Mapping[Role, RecordingContents]
    links: Mapping[Role, Sequence[LinkSample]]
    telemetry: Mapping[Role, Sequence[TelemetrySample]]

    @property
    def transfers(self) -> tuple[Transfer, ...]:
        """The transfers of the attempt."""
        return planned_evidence.transfers(self.plan, self.attempt.repeat.protocol)


def read(plan: Plan, attempt: Attempt, evidence: AttemptEvidence) -> AttemptRecord:
    """Return the readable recordings of an attempt."""
    captures = {name: evidence.read_or_none(pcap.read, name) for name in planned_evidence.captures(plan)}
    pings = {
        source.file: evidence.read_or_none(ping.read, source.file) for source in planned_evidence.ping_sources(plan)
    }
    bags = {role: evidence.read_or_none(recordings.read, name) for role, name in planned_evidence.bags(plan).items()}
    return AttemptRecord(
        plan=plan,
        attempt=attempt,
        captures={name: capture for name, capture in captures.items() if capture},
        pings={name: output for name, output in pings.items() if output},
        bags={role: content for role, content in bags.items() if content},
        links={role: evidence.links(role) for role in plan.cast},
        telemetry={role: telemetry_samples.read(evidence, role, robot.profile) for role, robot in plan.cast.items()},
    )


def omissions(record: AttemptRecord) -> Iterator[Json]:
    """Yield a log message for each damaged capture, and for each output of ping with replies without a time stamp."""

    def log_message(text: str, file: str) -> Json:
        name, t_ns = str(record.attempt.repeat), record.attempt.started_utc_ns
        return schemas.log(t_ns, Level.WARNING, text, name=name, file=f"repeats/{record.attempt.folder}/{file}")

    for file, capture in record.captures.items():
        if capture.damage:
            yield log_message(capture.damage, file)
    for file, pings in record.pings.items():
        if untimed := sum(reply.at_utc_ns is None for reply in pings.replies):
            yield log_message(f"replies without a time stamp are omitted: {untimed}", file)


def messages(record: AttemptRecord) -> Iterator[Message]:
    """Return the messages of the robots' recordings, in the order of their times; clock differences are ignored."""
    streams = []
    packets_by_file = packet_fates(record.captures, record.transfers)
    for file, role in planned_evidence.captures(record.plan).items():
        if file in record.captures:
            topic, meaning = (
                _named("packets", _step(file)),
                "IP packets in the robot's capture. With segmentation offload, one packet may have several segments.",
            )
            channel = _channel(record, role, topic, schemas.PACKET, meaning)
            streams.append(packet_messages(channel, record.attempt.folder, packets_by_file[file]))
    for role in record.plan.cast:
        robot_stream = [
            *_phases(record, role),
            *_links(record, role),
            *_telemetry(record, role),
            *_rtts(record, role),
        ]
        streams.append(iter(sorted(robot_stream, key=attrgetter("time_ns"))))
    return heapq.merge(*streams, key=attrgetter("time_ns"))


def _channel(record: AttemptRecord, role: Role, topic: str, schema: Json, meaning: str) -> Channel:
    return Channel(f"/{role}/{topic}", schema, f"{role} {record.plan.cast[role].name}", meaning)


def _named(topic: str, step: str) -> str:
    """Return the name of a topic relative to its robot: `rtt`, or `rtt/busy` for a step with a name."""
    return f"{topic}/{step}" if step else topic


def _step(file: str) -> str:
    """Return the name of the step of a capture; empty if the step has no name."""
    return Path(file).stem.rpartition(".")[0]


def _rtts(record: AttemptRecord, role: Role) -> Iterator[Message]:
    """Yield the replies and ICMP errors that a robot's ping printed, at the times of printing."""
    for source in planned_evidence.ping_sources(record.plan):
        if source.role == role and source.file in record.pings:
            yield from _replies(record, role, source.name, source.file)


def _replies(record: AttemptRecord, role: Role, step: str, file: str) -> Iterator[Message]:
    repeat, pings = record.attempt.folder, record.pings[file]
    channel = _channel(record, role, _named("rtt", step), schemas.RTT, "Replies to ping, at the times of printing.")
    for reply in pings.replies:
        if reply.at_utc_ns is not None:
            yield Message(channel, reply.at_utc_ns, schemas.rtt(reply.at_utc_ns, repeat, reply))
    log = _channel(record, role, "log", schemas.LOG, "ICMP errors instead of a reply to ping.")
    for problem in pings.problems:
        if problem.at_utc_ns is not None:
            text = f"icmp_seq={problem.seq}: {problem.source} reports {problem.text}"
            yield Message(
                log,
                problem.at_utc_ns,
                schemas.log(problem.at_utc_ns, Level.WARNING, text, name=repeat, file=file),
            )


def _links(record: AttemptRecord, role: Role) -> Iterator[Message]:
    channel = _channel(record, role, "link", schemas.LINK, "State of the radio's links, five times per second.")
    for sample in record.links[role]:
        yield Message(channel, sample.utc_ns, schemas.link(record.attempt.folder, sample))


def _telemetry(record: AttemptRecord, role: Role) -> Iterator[Message]:
    """Yield the values of the telemetry sources that a robot queried; each source has a channel."""
    for sample in record.telemetry[role]:
        meaning = "Values of a telemetry source of the robot's profile."
        channel = _channel(record, role, f"telemetry/{sample.source}", schemas.TELEMETRY, meaning)
        yield Message(channel, sample.utc_ns, schemas.telemetry(record.attempt.folder, sample))


def _phases(record: AttemptRecord, role: Role) -> Iterator[Message]:
    """Yield the start and end of a robot's recording, transfer and ping. Steps with a name have separate channels."""
    meaning = "Start and end of the robot's phases: first and last time stamp of the evidence."
    for step, phase, begin_ns, end_ns in _spans(record, role):
        channel = _channel(record, role, _named("phase", step), schemas.PHASE, meaning)
        for t_ns, name in ((begin_ns, phase), (end_ns, "idle")):
            yield Message(channel, t_ns, schemas.phase(t_ns, record.attempt.folder, name))


def _spans(record: AttemptRecord, role: Role) -> Iterator[tuple[str, str, int, int]]:
    """Yield the phases of a robot: name of the step (empty if it has no name), phase, start and end."""
    if bag := record.bags.get(role):
        yield "", "record", bag.started_utc_ns, bag.started_utc_ns + round(bag.duration_s * 1e9)
    for transfer in record.transfers:
        for end, file in zip((transfer.source, transfer.destination), transfer.captures, strict=True):
            if end == role and file is not None and file in record.captures:
                forward = transfer.forward(record.captures[file].packets)
                # If a transfer has a name, another transfer in the same direction may run at the same time.
                times_ns = (forward.where(forward.dport == transfer.port) if transfer.name else forward).time_ns
                if len(times_ns) and times_ns.min() != NO_TIME:
                    yield transfer.name, "transfer", int(times_ns.min()), int(times_ns.max())
    for source in planned_evidence.ping_sources(record.plan):
        if source.role == role and source.file in record.pings:
            replies = record.pings[source.file].replies
            stamps_ns = [reply.at_utc_ns for reply in replies if reply.at_utc_ns is not None]
            if stamps_ns:
                yield source.name, "ping", min(stamps_ns), max(stamps_ns)
