"""Packets of a video in captures, its columns, and contradictions between logs and captures, from built packets."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fieldkit.ros.streams.topic_samples import TopicLog, TopicSamples
from fieldkit.ros.video import rtp_packets, video_checks, video_columns
from fieldkit.ros.video.rtp_packets import NO_PACKET, RtpPackets
from tests.helpers.captures import RECEIVER, SENDER, Frame, file_bytes, ipv4

MS = 1_000_000
START = 1_795_000_000_000_000_000
PERIOD = 33 * MS
DELAY = 5 * MS
PORT = 5004
FRAMES, PACKETS = 12, 3


def packet(frame: int, part: int) -> bytes:
    """A packet of a frame; the RTP numbers wrap around early."""
    sequence = (65_530 + frame * PACKETS + part) % 2**16
    stamp = (2**32 - 4 * 3000 + frame * 3000) % 2**32
    header = struct.pack(">BBHII", 0x80, 26 | (part == PACKETS - 1) << 7, sequence, stamp, 7)
    payload = header + bytes(1388)
    udp = struct.pack(">HHHH", 40_000, PORT, 8 + len(payload), 0)
    return ipv4((udp + payload)[:60], protocol=17, size=8 + len(payload), ip_id=1 + frame * PACKETS + part)


def other_packets() -> list[bytes]:
    """Packets that are not RTP packets to the port: another port, another version, TCP, too short."""
    rtp = struct.pack(">BBHII", 0x80, 26, 1, 2, 3)
    return [
        ipv4(struct.pack(">HHHH", PORT, PORT + 1, 20, 0) + rtp, protocol=17),
        ipv4(struct.pack(">HHHH", PORT, PORT, 20, 0) + b"\0" + rtp[1:], protocol=17),
        ipv4(struct.pack(">HHHH", PORT, PORT, 20, 0) + rtp, protocol=6),
        ipv4(struct.pack(">HHHH", PORT, PORT, 20, 0) + rtp[:11], protocol=17),
        ipv4(struct.pack(">HHHH", PORT, PORT, 20, 0) + rtp, protocol=17, offset=1480),
        ipv4(struct.pack(">HHHH", PORT, 40_000, 20, 0) + rtp, protocol=17, src=RECEIVER, dst=SENDER),
    ]


def captured(folder: Path, lost: set[tuple[int, int]], *, copies: int = 1) -> tuple[RtpPackets, RtpPackets]:
    """The packets of both captures; `lost` are frame and part of packets that did not arrive."""
    sent, received = [], []
    for frame in range(FRAMES):
        for part in range(PACKETS):
            at_ns, data = START + frame * PERIOD + (1 + part) * MS, packet(frame, part)
            sent.append(Frame(at_ns, data, 1428))
            received += [Frame(at_ns + DELAY, data, 1428)] * (0 if (frame, part) in lost else copies)
    results = []
    for name, frames in (("sender", sent), ("receiver", received)):
        path = folder / f"{name}.pcap"
        path.write_bytes(file_bytes([*frames, *(Frame(START, other) for other in other_packets())]))
        results.append(rtp_packets.read(path, PORT))
    return results[0], results[1]


def logs(lost: set[int] = frozenset()) -> tuple[TopicLog, TopicLog]:  # type: ignore[assignment]
    """Consistent logs of both ends; `lost` are the frames that the receiver did not decode."""
    numbers = np.arange(FRAMES)
    sent_ns = START + numbers * PERIOD
    arrived = np.array([number for number in range(FRAMES) if number not in lost], dtype=np.int64)
    ends = []
    for sequence, at_ns in ((numbers, sent_ns + MS), (arrived, sent_ns[arrived] + PACKETS * MS + DELAY + 2 * MS)):
        samples = TopicSamples(sequence, np.full(len(sequence), 9), sent_ns[sequence], at_ns)
        ends.append(TopicLog(samples, START, START, 0, 0, 0, is_complete=True))
    return ends[0], ends[1]


LOST = st.sets(st.tuples(st.integers(0, FRAMES - 1), st.integers(0, PACKETS - 1)))


@given(LOST, st.integers(1, 2))
def test_frames_have_their_packets(
    tmp_path_factory: pytest.TempPathFactory, lost: set[tuple[int, int]], copies: int
) -> None:
    sent, received = captured(tmp_path_factory.mktemp("captures"), lost, copies=copies)
    assert len(sent) == FRAMES * PACKETS
    frames = rtp_packets.match_frames(sent, received)
    for number in range(FRAMES):
        parts = [part for part in range(PACKETS) if (number, part) not in lost]
        times_ns = [START + number * PERIOD + (1 + part) * MS + DELAY for part in parts]
        assert frames.sent_ns[number] == START + number * PERIOD + MS
        assert (frames.packets[number], frames.arrived[number]) == (PACKETS, len(parts))
        assert frames.first_ns[number] == min(times_ns, default=NO_PACKET)
        assert frames.last_ns[number] == max(times_ns, default=NO_PACKET)


def test_columns(tmp_path: Path) -> None:
    sent, received = captured(tmp_path, {(2, 0), (2, 1), (7, 2)})
    of_sender, of_receiver = logs({2, 4, 7})
    of_receiver = replace(of_receiver, unreadable=1)
    frames = video_columns.measure_frames(of_sender, of_receiver)
    assert frames.values == {
        "video_sent": FRAMES,
        "video_received": FRAMES - 3,
        "video_loss": pytest.approx(3 / FRAMES),
        "video_skipped": 0,
        "video_unreadable": 1,
    }
    packets = video_columns.measure_packets(sent, received, of_receiver, PERIOD / 1e9)
    assert packets.values == {
        "video_packets": FRAMES * PACKETS,
        "video_packet_loss": pytest.approx(3 / (FRAMES * PACKETS)),
        "video_bit_s": pytest.approx(8 * 1428 * PACKETS / (PERIOD / 1e9)),
        "video_undecoded": 1,  # frame 4: all packets arrived
    }
    assert not video_columns.measure_packets(sent, None, of_receiver, 1.0).values
    assert not video_columns.measure_frames(None, of_receiver).values
    # Nothing was sent: no value, in particular no loss of 0.
    nothing = sent.where(slice(0, 0))
    assert not video_columns.measure_packets(nothing, nothing, of_receiver, 1.0).values


def changed(log: TopicLog, **columns: "np.typing.NDArray[np.int64]") -> TopicLog:
    return replace(log, samples=replace(log.samples, **columns))


def test_consistent_evidence_has_no_contradiction(tmp_path: Path) -> None:
    packets = captured(tmp_path, {(2, 0), (2, 1), (2, 2), (7, 2)})
    assert list(video_checks.check_captures(*logs({2, 7}), *packets)) == []


def test_contradictions(tmp_path: Path) -> None:
    packets = captured(tmp_path, {(3, 0), (3, 1), (3, 2)})
    sent, received = logs({3})

    def reasons(sent: TopicLog, received: TopicLog) -> str:
        return "; ".join(video_checks.check_captures(sent, received, *packets))

    fewer = changed(sent, **{name: column[:-1] for name, column in vars(sent.samples).items()})
    assert reasons(fewer, received) == "the sender's capture has 12 frames of the video, but its log has 11"
    later = changed(sent, sent_ns=sent.samples.sent_ns + 2 * MS)
    assert "the sender's capture has 12 frames sent before the time of the frame" in reasons(later, received)
    assert "the receiver's capture has no packet of 1 frame in its log" in reasons(sent, logs()[1])
    soon = changed(received, at_ns=received.samples.at_ns - 3 * MS)
    assert "11 frames in the receiver's log arrived before the last packet" in reasons(sent, soon)
    sooner = changed(received, at_ns=received.samples.at_ns - 6 * MS)
    assert "11 frames in the receiver's log arrived before the packets" in reasons(sent, sooner)
    assert "has 16 frames, but its capture has packets of 11" in reasons(sent, replace(received, unreadable=5))
