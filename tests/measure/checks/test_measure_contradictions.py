"""Losses, copies, reordering and clock offsets of a link are not contradictions, but impossible evidence is."""

import random
import struct
import tempfile
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.core.model import Protocol
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.checks import transfer_checks
from tests.helpers.captures import PORT, RECEIVER, SENDER, Frame, datagram, file_bytes, ipv4, segment, transfer

SYN, FIN, ACK = 0x02, 0x01, 0x10
SPORT = 40_000

SEEDS = st.integers(0, 2**32)
SHARES = st.sampled_from((0.0, 0.05, 0.3, 0.9))
"""Shares of packets that are lost, copied or delayed."""


class Link:
    """A link that loses, copies and delays packets, with captures at both ends."""

    def __init__(self, seed: int, lost_share: float, copied_share: float, delayed_share: float) -> None:
        self.random_generator = random.Random(seed)
        self.shares = lost_share, copied_share, delayed_share
        self.ahead_ns = self.random_generator.randrange(-(10**15), 10**15)
        self.now_ns = 1_700_000_000_000_000_000
        self.sent: list[Frame] = []
        self.received: list[Frame] = []

    def carry(self, data: bytes, *, reverse: bool = False) -> int:
        """Send a packet and return the number of copies that arrive."""
        from_frames, to_frames = (self.received, self.sent) if reverse else (self.sent, self.received)
        ahead_ns = (self.ahead_ns, 0) if reverse else (0, self.ahead_ns)
        self.now_ns += 1_000_000
        from_frames.append(Frame(self.now_ns + ahead_ns[0], data))
        is_lost, is_copied, is_delayed = (self.random_generator.random() < share for share in self.shares)
        copies = 0 if is_lost else 2 if is_copied else 1
        for _ in range(copies):
            delay_ns = self.random_generator.randrange(50_000_000 if is_delayed else 1_000_000)
            to_frames.append(Frame(self.now_ns + delay_ns + ahead_ns[1], data))
        return copies

    def contradictions(
        self, protocol: Protocol, sent_file: bytes, received_file: bytes, *, finished: bool, captured: bool = True
    ) -> list[str]:
        with tempfile.TemporaryDirectory() as temporary_folder:
            folder = Path(temporary_folder)
            for name, content in (
                ("scan.bag", sent_file),
                ("recv.bag", received_file),
                ("sender.pcap", file_bytes_of(self.sent)),
                ("receiver.pcap", file_bytes_of(self.received)),
            ):
                (folder / name).write_bytes(content)
            evidence = AttemptEvidence(folder)
            transfer_spec = transfer(protocol) if captured else replace(transfer(protocol), captures=(None, None))
            return list(transfer_checks.find_contradictions(evidence, transfer_spec, finished=finished))


def file_bytes_of(frames: Iterable[Frame]) -> bytes:
    return file_bytes(sorted(frames, key=lambda frame: frame.time_ns))


def frame(seq: int, ack: int, flags: int, payload_bytes: int = 0, *, reverse: bool = False) -> bytes:
    ports = (PORT, SPORT) if reverse else (SPORT, PORT)
    header = struct.pack(">HHIIBBHHH", *ports, seq % 2**32, ack % 2**32, 5 << 4, flags, 502, 0, 0)
    src, dst = (RECEIVER, SENDER) if reverse else (SENDER, RECEIVER)
    return ipv4(header, protocol=6, size=20 + payload_bytes, src=src, dst=dst)


@given(SEEDS, SHARES, SHARES, SHARES, st.integers(1, 30))
def test_a_udp_transfer_over_any_link_has_no_contradiction(
    seed: int, lost_share: float, copied_share: float, delayed_share: float, datagrams: int
) -> None:
    link = Link(seed, lost_share, copied_share, delayed_share)
    random_generator = random.Random(seed)
    parts = [random_generator.randbytes(random_generator.randrange(1, 9_000)) for _ in range(datagrams)]
    received_datagrams: list[bytes] = []
    for number, part in enumerate(parts):
        copies = min([link.carry(packet) for packet in datagram(number, len(part))])
        # The buffer of the socket may be full.
        received_datagrams += [part] * random_generator.randrange(copies + 1)
    random_generator.shuffle(received_datagrams)
    assert link.contradictions(Protocol.UDP, b"".join(parts), b"".join(received_datagrams), finished=True) == []


@given(SEEDS, SHARES, SHARES, SHARES, st.integers(0, 40))
def test_a_tcp_transfer_over_any_link_has_no_contradiction(
    seed: int, lost_share: float, copied_share: float, delayed_share: float, segments: int
) -> None:
    link = Link(seed, lost_share, copied_share, delayed_share)
    random_generator = random.Random(seed)
    isn = random_generator.choice((0, 2**32 - 5_000, random_generator.randrange(2**32)))
    sizes = [random_generator.randrange(1, 3_000) for _ in range(segments)]
    data = random_generator.randbytes(sum(sizes))
    starts = [sum(sizes[:index]) for index in range(segments)]
    # The sender gives up after some time, and the transfer ends incomplete.
    tries_left = random_generator.randrange(1, 500)
    arrived_segments, is_finished = set[int](), False

    def send(offset: int, flags: int, size: int = 0) -> bool:
        nonlocal tries_left
        while tries_left > 0:
            tries_left -= 1
            if link.carry(frame(isn + offset, 0, flags, size)):
                return True
        return False

    def acknowledge(ack: int, flags: int = ACK) -> None:
        link.carry(frame(77, isn + ack, flags, reverse=True), reverse=True)

    if send(0, SYN):
        acknowledge(1, SYN | ACK)
        send_order = sorted(range(segments), key=lambda index: index + random_generator.random() * 3)
        for index in (*send_order, *random_generator.choices(send_order, k=3)) if send_order else ():
            if not send(1 + starts[index], ACK, sizes[index]):
                break
            arrived_segments.add(index)
            n_contiguous = next((number for number in range(segments) if number not in arrived_segments), segments)
            acknowledge(1 + sum(sizes[:n_contiguous]))
        if len(arrived_segments) == segments and send(1 + len(data), FIN | ACK):
            is_finished = True
            acknowledge(2 + len(data))
    n_contiguous = next((number for number in range(segments) if number not in arrived_segments), segments)
    received_file = data[: sum(sizes[:n_contiguous])]
    if not is_finished:  # the listener was stopped at its time limit, so it may not have read everything
        received_file = received_file[: random_generator.randrange(len(received_file) + 1)]
    assert link.contradictions(Protocol.TCP, data, received_file, finished=is_finished) == []


def test_a_datagram_that_was_not_captured_at_the_sender_is_a_contradiction() -> None:
    """A single datagram may belong to earlier traffic, so it does not show that a router alters packets."""
    link = Link(0, 0.0, 0.0, 0.0)
    for number in range(3):
        link.carry(datagram(number, 1000)[0])
    del link.sent[1]
    reasons = link.contradictions(Protocol.UDP, bytes(3000), bytes(3000), finished=True)
    assert reasons == ["the sender's capture lacks 1 datagram that arrived"]


def three_segments() -> Link:
    link = Link(0, 0.0, 0.0, 0.0)
    link.carry(frame(0, 0, SYN))
    for number in range(3):
        link.carry(frame(1 + 100 * number, 0, ACK, 100))
    return link


def test_bytes_that_were_not_captured_at_the_sender_are_a_contradiction(monkeypatch: pytest.MonkeyPatch) -> None:
    link = three_segments()
    del link.sent[2]
    reasons = link.contradictions(Protocol.TCP, bytes(300), bytes(300), finished=True)
    assert reasons == ["the sender's capture lacks 100 bytes that arrived"]
    assert link.contradictions(Protocol.TCP, bytes(300), bytes(300), finished=True, captured=False) == []
    monkeypatch.setattr(transfer_checks, "LONGEST_BYTES", 300)
    assert link.contradictions(Protocol.TCP, bytes(300), bytes(300), finished=True) == [], (
        "sequence numbers may have wrapped"
    )


def test_retransmissions_of_an_earlier_connection_are_not_a_contradiction() -> None:
    link = three_segments()
    link.carry(segment(7_000, 100, sport=SPORT - 1))
    assert link.contradictions(Protocol.TCP, bytes(300), bytes(300), finished=True) == []


def test_acknowledged_bytes_that_are_in_neither_capture_are_a_contradiction() -> None:
    link = three_segments()
    link.carry(frame(77, 301, ACK, reverse=True), reverse=True)
    del link.sent[2], link.received[2]
    assert link.contradictions(Protocol.TCP, bytes(300), bytes(200), finished=False) == [
        f"100 bytes were acknowledged, but are not in the {role}'s capture" for role in ("sender", "receiver")
    ]


def test_bytes_after_a_gap_may_be_missing_in_the_file() -> None:
    """The listener exited early and the sender did not finish, so no program had all bytes."""
    link = Link(0, 0.0, 0.0, 0.0)
    link.carry(frame(0, 0, SYN))
    link.carry(frame(0, 1, SYN | ACK, reverse=True), reverse=True)
    for number in (0, 2):
        link.carry(frame(1 + 100 * number, 0, ACK, 100))
    link.carry(segment(9, 0, flags=0x04, port=11_311, back=True), reverse=True)  # ROS refuses another connection
    assert link.contradictions(Protocol.TCP, bytes(300), bytes(100), finished=True) == []
    link.carry(segment(9, 0, flags=0x04, back=True), reverse=True)
    (reasons,) = link.contradictions(Protocol.TCP, bytes(300), bytes(100), finished=True)
    assert reasons.endswith("although its listener exited normally"), "the listener closed the connection early"


def test_a_fragment_of_another_program_is_not_part_of_the_transfer() -> None:
    """A capture contains later fragments of all programs on the robots, and the radio may lose them."""
    link = Link(0, 0.0, 0.0, 0.0)
    for number, port in ((0, PORT), (1, 7400), (2, PORT)):
        for packet in datagram(number, 3000, port=port):
            link.carry(packet)
    lost_index = next(
        index for index, packet in enumerate(link.received) if packet.data in datagram(1, 3000, port=7400)[1:]
    )
    del link.received[lost_index]
    assert link.contradictions(Protocol.UDP, bytes(6000), bytes(6000), finished=True) == []


def test_packets_missing_in_a_capture_of_a_complete_file_are_reported_once() -> None:
    link = Link(0, 0.0, 0.0, 0.0)
    for number in range(3):
        link.carry(datagram(number, 1000)[0])
    del link.received[1]
    reasons = link.contradictions(Protocol.UDP, bytes(3000), bytes(3000), finished=True)
    assert reasons == ["the receiver's capture contains 2000 bytes of the transfer, but recv.bag has 3000"]
