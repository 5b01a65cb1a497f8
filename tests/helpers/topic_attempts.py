"""Synthetic evidence of a topic between two robots: the logs and captures of a valid attempt, for tests to change."""

import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from fieldkit.agent.messaging import records
from fieldkit.agent.messaging.records import Log
from fieldkit.core.columns import Measured
from fieldkit.measure.captures import pcap
from fieldkit.ros.streams import topic_captures, topic_checks, topic_columns, topic_samples
from fieldkit.ros.streams.topic_captures import CapturedTopic
from fieldkit.ros.streams.topic_checks import TopicPlan
from fieldkit.ros.streams.topic_columns import TopicTraffic
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
"""The offset of the subscriber's clock."""

PLAN: Final = TopicPlan(
    "/stream", SAMPLES, BYTES, 16, reliable=True, depth=10, in_order=True, uses_expected_ports=True
)
TRAFFIC: Final = TopicTraffic(SENDER, RECEIVER, frozenset({PORT}), frozenset({17900}), deadline_s=0.2)

Row = tuple[int, int, int, int, int]
"""Kind, size, sequence number, send time, local time."""


@dataclass(frozen=True)
class TopicAttempt:
    """The evidence of a topic.

    Attributes:
        sent: Rows of the publisher's log, without the end record.
        came: Rows of the subscriber's log, without the end record.
        publisher_frames: Frames of the publisher's capture.
        subscriber_frames: Frames of the subscriber's capture.
        plan: The requested topic.
    """

    sent: tuple[Row, ...]
    received: tuple[Row, ...]
    sender_frames: tuple[Frame, ...]
    receiver_frames: tuple[Frame, ...]
    plan: TopicPlan = PLAN


def attempt(*, tcp: bool = False, lost: Sequence[int] = (), plan: TopicPlan = PLAN) -> TopicAttempt:
    """A valid attempt; the samples in `lost` are missing in the subscriber's capture and log."""
    start_ns, matched_ns = START - 2 * SECOND, START - 600 * MS
    size = plan.size_bytes + plan.envelope_bytes
    start_rows = [(records.DISCOVERY_STARTED, 0, 0, 0, start_ns), (records.MATCHED, 0, 0, 0, matched_ns)]
    sent, received = (
        [*start_rows],
        [
            (kind, row_size, number, 0, sample_ns - SECOND + AHEAD)
            for kind, row_size, number, _, sample_ns in start_rows
        ],
    )
    publisher_frames, subscriber_frames = [], []
    for number in range(plan.samples):
        sample_ns = START + number * PERIOD
        sent.append((records.SAMPLE, size, number, sample_ns, sample_ns + 90 * US))
        packet = _packet(number, sample_ns, plan, tcp=tcp)
        publisher_frames.append(Frame(sample_ns + 60 * US, packet[:236], len(packet)))
        acknowledgement = _acknowledgement(number, plan, tcp=tcp)
        # An echo request and its reply limit the uncertainty of the clock offset to 30 us.
        for is_request, publisher_ns, subscriber_ns in (
            (True, sample_ns + 10 * MS, sample_ns + 10 * MS + 20 * US),
            (False, sample_ns + 12 * MS, sample_ns + 12 * MS - 20 * US),
        ):
            echo = _echo(number, is_request=is_request)
            publisher_frames.append(Frame(publisher_ns, echo))
            subscriber_frames.append(Frame(subscriber_ns + AHEAD, echo))
        if number not in lost:
            subscriber_ns = sample_ns + MS + 7 * US * (number % 13) + AHEAD
            subscriber_frames.append(Frame(subscriber_ns, packet[:236], len(packet)))
            subscriber_frames.append(Frame(subscriber_ns + 50 * US, acknowledgement))
            publisher_frames.append(Frame(subscriber_ns - AHEAD + 70 * US, acknowledgement))
            received.append((records.SAMPLE, size, number, sample_ns, subscriber_ns + 200 * US))
    end_ns = START + plan.samples * PERIOD + SECOND
    publisher_frames.append(Frame(end_ns, _acknowledgement(plan.samples, plan, tcp=tcp)))
    return TopicAttempt(tuple(sent), tuple(received), tuple(publisher_frames), tuple(subscriber_frames), plan)


def _packet(number: int, at_ns: int, plan: TopicPlan, *, tcp: bool) -> bytes:
    padding = struct.pack("<III", 0, 0, plan.size_bytes)
    sample_header = b"fieldkit" + struct.pack("<qq", number, at_ns)
    payload = bytes(56) + padding + sample_header + bytes(plan.size_bytes - len(sample_header))
    if not tcp:
        return ipv4(struct.pack(">HHHH", 40000, PORT, 8 + len(payload), 0) + payload, protocol=17, ip_id=number)
    tcp_sequence = 1_000 + number * len(payload)
    header = struct.pack(">HHIIBBHHH", PORT, 40000, tcp_sequence, 1, 5 << 4, 0x18, 502, 0, 0)
    return ipv4(header + payload, protocol=6, ip_id=number)


def _echo(number: int, *, is_request: bool) -> bytes:
    src, dst = (SENDER, RECEIVER) if is_request else (RECEIVER, SENDER)
    return ipv4(bytes([8 * is_request, 0, 0, 0, 0, 1, 0, number]), protocol=1, ip_id=number, src=src, dst=dst)


def _acknowledgement(number: int, plan: TopicPlan, *, tcp: bool) -> bytes:
    """The packet that acknowledges a sample."""
    ip_fields = {"src": RECEIVER, "dst": SENDER, "ip_id": 30_000 + number}
    if not tcp:
        return ipv4(struct.pack(">HHHH", PORT, PORT, 8 + 64, 0) + bytes(64), protocol=17, **ip_fields)  # type: ignore[arg-type]
    ack_number = 1_000 + (number + 1) * (plan.size_bytes + 68)
    header = struct.pack(">HHIIBBHHH", 40000, PORT, 1, ack_number, 5 << 4, 0x10, 502, 0, 0)
    return ipv4(header, protocol=6, **ip_fields)  # type: ignore[arg-type]


def write(topic_attempt: TopicAttempt, folder: Path, *, signed: bool = True) -> None:
    """Write an attempt as the agent and tcpdump would; without `signed`, in the old log format without a checksum."""
    end = START + topic_attempt.plan.samples * PERIOD + 2 * SECOND
    for role, rows, log_kind, end_ns in (
        ("sender", topic_attempt.sent, records.PUBLISHER, end),
        ("receiver", topic_attempt.received, records.SUBSCRIBER, end + AHEAD),
    ):
        path = folder / f"{role}-topic.bin"
        log = Log(str(path))
        if signed:
            log.write_role(rows[0][-1] - 1, log_kind, topic_attempt.plan.topic)
        for kind, size, number, sent_ns, at_ns in rows:
            log.note(kind, at_ns, size=size, sequence=number, sent_ns=sent_ns)
        log.end(end_ns)
        if not signed:
            content = path.read_bytes()[: -records.RECORD.size]
            samples = sum(row[0] == records.SAMPLE for row in rows)
            path.write_bytes(content + records.RECORD.pack(records.END, 0, 0, samples, 0, end_ns))
    for role, frames in (("sender", topic_attempt.sender_frames), ("receiver", topic_attempt.receiver_frames)):
        sorted_frames = sorted(frames, key=lambda frame: frame.time_ns)
        (folder / f"{role}.pcap").write_bytes(file_bytes(sorted_frames))


def judge_attempt(topic_attempt: TopicAttempt, folder: Path, *, signed: bool = True) -> tuple[list[str], Measured]:
    """The contradictions in an attempt, and its measured values."""
    write(topic_attempt, folder, signed=signed)
    sent, received = (topic_samples.read_log(folder / f"{role}-topic.bin") for role in ("sender", "receiver"))
    flows, packets = [], []
    for role, address in (("sender", SENDER), ("receiver", RECEIVER)):
        path, is_publisher = folder / f"{role}.pcap", role == "sender"
        packets.append(pcap.read(path).packets)
        headers = topic_samples.find_heads(path, topic_attempt.plan.size_bytes)
        flows.append(
            topic_samples.sample_flow(
                packets[-1],
                headers,
                frozenset({PORT}),
                topic_attempt.plan.size_bytes,
                lambda selected, address=address, is_publisher=is_publisher: (
                    selected.are_from(address) == is_publisher
                ),  # type: ignore[misc]
            )
        )
    sender_flow, receiver_flow = flows
    captured = CapturedTopic(
        sender_flow, receiver_flow, complete=topic_captures.is_complete(sender_flow, receiver_flow)
    )
    reasons = [f"{end.foreign} foreign" for end in (sent, received) if end.foreign]  # as the step reports it
    reasons += topic_checks.check_logs(topic_attempt.plan, sent, received)
    reasons += [] if reasons else topic_captures.check_captures(topic_attempt.plan, sent, received, captured)
    measured = topic_columns.measure(TRAFFIC, sent, received, *packets)
    arrived = topic_columns.first_arrivals(received)
    withheld = topic_captures.withheld_columns(
        measured.values, arrived, captured, reliable=topic_attempt.plan.reliable, deadline_s=TRAFFIC.deadline_s
    )
    return reasons, measured.without(withheld)


def best_effort() -> TopicPlan:
    """The plan of a best-effort topic, which has no retransmissions."""
    return replace(PLAN, reliable=False)
