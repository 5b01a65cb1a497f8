"""A topic between two robots as its two logs and two captures hold it, made up: a valid attempt to be changed."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from fieldkit.agent import records
from fieldkit.agent.records import Log
from fieldkit.core.columns import Measured
from fieldkit.measure.captures import pcap
from fieldkit.measure.checks import topic_captures, topic_checks
from fieldkit.measure.checks.topic_captures import Captured
from fieldkit.measure.checks.topic_checks import TopicPlan
from fieldkit.measure.transfers import sample_heads, topic_log, topics
from fieldkit.measure.transfers.topics import TopicTraffic
from tests.helpers.captures import RECEIVER, SENDER, Frame, file_bytes, ipv4

US: Final = 1_000
MS: Final = 1_000_000
SECOND: Final = 1_000_000_000
START: Final = 1_795_000_000 * SECOND
PERIOD: Final = 50 * MS
PORT: Final = 17911
BYTES: Final = 1000
SAMPLES: Final = 40
AHEAD: Final = 3 * SECOND
"""The subscriber's clock is ahead by this."""

PLAN: Final = TopicPlan("/stream", SAMPLES, BYTES, 16, reliable=True, depth=10, in_order=True, on_ports=True)
TRAFFIC: Final = TopicTraffic(SENDER, RECEIVER, frozenset({PORT}), frozenset({17900}), deadline_s=0.2)

Row = tuple[int, int, int, int, int]
"""Kind, size, sequence number, time of sending, time here."""


@dataclass(frozen=True)
class TopicAttempt:
    """A topic's evidence.

    Attributes:
        sent: Rows of the publisher's log, its end not among them.
        came: Rows of the subscriber's.
        near: Frames of the publisher's capture.
        far: Frames of the subscriber's.
        plan: What was asked for.
    """

    sent: tuple[Row, ...]
    came: tuple[Row, ...]
    near: tuple[Frame, ...]
    far: tuple[Frame, ...]
    plan: TopicPlan = PLAN


def attempt(*, tcp: bool = False, lost: Sequence[int] = (), plan: TopicPlan = PLAN) -> TopicAttempt:
    """Return a valid attempt; samples `lost` are not in the subscriber's capture, nor in its log."""
    begun, matched = START - 2 * SECOND, START - 600 * MS
    size = plan.size_bytes + plan.envelope_bytes
    head = [(records.BEGUN, 0, 0, 0, begun), (records.MATCHED, 0, 0, 0, matched)]
    sent, came = [*head], [(kind, size_, number, 0, at - SECOND + AHEAD) for kind, size_, number, _, at in head]
    near, far = [], []
    for number in range(plan.samples):
        at = START + number * PERIOD
        sent.append((records.SAMPLE, size, number, at, at + 90 * US))
        packet = _packet(number, at, plan, tcp=tcp)
        near.append(Frame(at + 60 * US, packet[:236], len(packet)))
        answer = _answer(number, plan, tcp=tcp)
        # Both clocks are known to 30 us by an echo and its reply.
        for asks, here, there in (
            (True, at + 10 * MS, at + 10 * MS + 20 * US),
            (False, at + 12 * MS, at + 12 * MS - 20 * US),
        ):
            echo = _echo(number, asks=asks)
            near.append(Frame(here, echo))
            far.append(Frame(there + AHEAD, echo))
        if number not in lost:
            there = at + MS + 7 * US * (number % 13) + AHEAD
            far.append(Frame(there, packet[:236], len(packet)))
            far.append(Frame(there + 50 * US, answer))
            near.append(Frame(there - AHEAD + 70 * US, answer))
            came.append((records.SAMPLE, size, number, at, there + 200 * US))
    end = START + plan.samples * PERIOD + SECOND
    near.append(Frame(end, _answer(plan.samples, plan, tcp=tcp)))
    return TopicAttempt(tuple(sent), tuple(came), tuple(near), tuple(far), plan)


def _packet(number: int, at_ns: int, plan: TopicPlan, *, tcp: bool) -> bytes:
    layout = struct.pack("<III", 0, 0, plan.size_bytes)
    head = b"fieldkit" + struct.pack("<qq", number, at_ns)
    payload = bytes(56) + layout + head + bytes(plan.size_bytes - len(head))
    if not tcp:
        return ipv4(struct.pack(">HHHH", 40000, PORT, 8 + len(payload), 0) + payload, protocol=17, ip_id=number)
    begin = 1_000 + number * len(payload)
    header = struct.pack(">HHIIBBHHH", PORT, 40000, begin, 1, 5 << 4, 0x18, 502, 0, 0)
    return ipv4(header + payload, protocol=6, ip_id=number)


def _echo(number: int, *, asks: bool) -> bytes:
    src, dst = (SENDER, RECEIVER) if asks else (RECEIVER, SENDER)
    return ipv4(bytes([8 * asks, 0, 0, 0, 0, 1, 0, number]), protocol=1, ip_id=number, src=src, dst=dst)


def _answer(number: int, plan: TopicPlan, *, tcp: bool) -> bytes:
    """Return what acknowledges a sample."""
    ends = {"src": RECEIVER, "dst": SENDER, "ip_id": 30_000 + number}
    if not tcp:
        return ipv4(struct.pack(">HHHH", PORT, PORT, 8 + 64, 0) + bytes(64), protocol=17, **ends)  # type: ignore[arg-type]
    until = 1_000 + (number + 1) * (plan.size_bytes + 68)
    header = struct.pack(">HHIIBBHHH", 40000, PORT, 1, until, 5 << 4, 0x10, 502, 0, 0)
    return ipv4(header, protocol=6, **ends)  # type: ignore[arg-type]


def write(made: TopicAttempt, folder: Path, *, signed: bool = True) -> None:
    """Write an attempt as the agent and tcpdump do; without `signed` as agents did that wrote no checksum."""
    end = START + made.plan.samples * PERIOD + 2 * SECOND
    for role, rows, which, end_ns in (
        ("sender", made.sent, records.PUBLISHER, end),
        ("receiver", made.came, records.SUBSCRIBER, end + AHEAD),
    ):
        path = folder / f"{role}-topic.bin"
        log = Log(str(path))
        if signed:
            log.origin(rows[0][-1] - 1, which, made.plan.topic)
        for kind, size, number, sent_ns, at_ns in rows:
            log.note(kind, at_ns, size=size, sequence=number, sent_ns=sent_ns)
        log.end(end_ns)
        if not signed:
            content = path.read_bytes()[: -records.RECORD.size]
            samples = sum(row[0] == records.SAMPLE for row in rows)
            path.write_bytes(content + records.RECORD.pack(records.END, 0, 0, samples, 0, end_ns))
    for role, frames in (("sender", made.near), ("receiver", made.far)):
        ordered = sorted(frames, key=lambda frame: frame.time_ns)
        (folder / f"{role}.pcap").write_bytes(file_bytes(ordered))


def judged(made: TopicAttempt, folder: Path, *, signed: bool = True) -> tuple[list[str], Measured]:
    """Return the contradictions in an attempt, and what it measures."""
    write(made, folder, signed=signed)
    sent, came = (topic_log.read(folder / f"{role}-topic.bin") for role in ("sender", "receiver"))
    flows, packets = [], []
    for role, address in (("sender", SENDER), ("receiver", RECEIVER)):
        path, publishes = folder / f"{role}.pcap", role == "sender"
        packets.append(pcap.read(path).packets)
        found = sample_heads.find(path, made.plan.size_bytes)
        flows.append(
            sample_heads.flow(
                packets[-1],
                found,
                frozenset({PORT}),
                made.plan.size_bytes,
                lambda of, address=address, publishes=publishes: of.are_from(address) == publishes,  # type: ignore[misc]
            )
        )
    near, far = flows
    captured = Captured(near, far, complete=topic_captures.is_complete(near, far))
    reasons = [f"{end.foreign} foreign" for end in (sent, came) if end.foreign]  # as the step says itself
    reasons += topic_checks.of_logs(made.plan, sent, came)
    reasons += [] if reasons else topic_captures.of_captures(made.plan, sent, came, captured)
    measured = topics.measure(TRAFFIC, sent, came, *packets)
    arrived = topics.first_arrivals(came)
    late = topic_captures.withheld(
        measured.values, arrived, captured, reliable=made.plan.reliable, deadline_s=TRAFFIC.deadline_s
    )
    return reasons, measured.without(late)


def best_effort() -> TopicPlan:
    """Return the plan of a topic that sends nothing again."""
    return replace(PLAN, reliable=False)
