"""Packets that are altered between the captures are detected and reported, and are not counted."""

import re
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.core.model import Protocol
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.transfers import altered_packets, fates
from tests.helpers import links
from tests.helpers.captures import PORT, RECEIVER, SENDER, Frame, datagram, file_bytes, packets, timed, transfer
from tests.helpers.casts import los_plan
from tests.helpers.links import Link
from tests.helpers.measures import measure
from tests.helpers.plans import problems

Change = Callable[[bytes], bytes]

ROUTER = "10.9.0.77"
TRANSLATED = "a router on the path translates an address or a port"
CHANGED = "they were changed on the path, or the sender's capture is incomplete"


def _with_field(offset: int, form: str, value: int) -> Change:
    def change(packet: bytes) -> bytes:
        changed = bytearray(packet)
        struct.pack_into(form, changed, offset, value)
        return bytes(changed)

    return change


def _with_increment(offset: int, form: str, increment: int) -> Change:
    def change(packet: bytes) -> bytes:
        (old_value,) = struct.unpack_from(form, packet, offset)
        return _with_field(offset, form, (old_value + increment) % 256 ** struct.calcsize(form))(packet)

    return change


def _change_port(packet: bytes) -> bytes:
    """Change the port of packets with a port. Only the first fragment of a datagram has one."""
    return packet if packet[6:8] not in {b"\0\0", b"\x20\0", b"\x40\0"} else _with_field(20, ">H", 55_555)(packet)


_change_source = _with_field(12, ">I", int.from_bytes(bytes((10, 9, 0, 77))))
_change_target = _with_field(16, ">I", int.from_bytes(bytes((10, 9, 0, 78))))
TRANSLATIONS: dict[str, tuple[Change, str]] = {
    "the source's address": (_change_source, TRANSLATED),
    "the target's address": (_change_target, TRANSLATED),
    "the source's address and port": (lambda packet: _change_port(_change_source(packet)), TRANSLATED),
    "the source's port": (_change_port, TRANSLATED),
}


def _udp(change: Change, *, lost_one_of: int = 10, ip_id: int | None = None) -> tuple[list[Frame], list[Frame]]:
    """Return captures of 36 datagrams of six fragments. One in `lost_one_of` packets is lost."""
    cut_packets = [packet for number in range(36) for packet in datagram(number if ip_id is None else ip_id, 8192)]
    sent_frames = timed(cut_packets)
    return sent_frames, [
        Frame(frame.time_ns, change(frame.data), 2000)
        for index, frame in enumerate(sent_frames)
        if index % lost_one_of != 3
    ]


def _tcp(change: Change, *, has_time_stamps: bool = True) -> tuple[list[Frame], list[Frame]]:
    truth = links.tcp(Link(4, loss=0.1), 200, ids=True, offload=10, stamped=has_time_stamps)
    return truth.sender, [Frame(frame.time_ns, change(frame.data), frame.wire_bytes) for frame in truth.receiver]


def _reason(captures: tuple[list[Frame], list[Frame]], protocol: Protocol) -> str | None:
    sender, receiver = map(packets, captures)
    return altered_packets.incomparability_reason(sender, receiver, transfer(protocol))


@pytest.mark.parametrize("protocol", Protocol)
@pytest.mark.parametrize("translation", TRANSLATIONS)
def test_a_translated_address_or_port_is_reported(translation: str, protocol: Protocol) -> None:
    change, expected_reason = TRANSLATIONS[translation]
    reason = _reason(_udp(change) if protocol is Protocol.UDP else _tcp(change), protocol)
    assert reason
    assert reason.endswith(expected_reason)
    assert f"as {SENDER}:40000 > {RECEIVER}:{PORT} and reached the receiver as " in reason
    assert not translation.endswith("port") or ":55555 > " in reason


@pytest.mark.parametrize(
    "change",
    [_with_increment(24, ">I", 1 << 31), _with_increment(44, ">I", 77_777)],
    ids=["sequence numbers", "time stamps"],
)
def test_changed_sequence_numbers_are_reported(change: Change) -> None:
    reason = _reason(_tcp(change), Protocol.TCP)
    assert reason
    assert reason.endswith(CHANGED)


def test_changed_ids_are_reported() -> None:
    reason = _reason(_udp(_with_increment(4, ">H", 30_000)), Protocol.UDP)
    assert reason
    assert reason.endswith(CHANGED)


def test_a_port_that_changes_during_the_transfer_is_reported() -> None:
    """As if a router lost its state for the flow: half of the packets arrive unchanged."""
    sent_frames, received_frames = _udp(lambda packet: packet)
    half = len(received_frames) // 2
    translated = [Frame(frame.time_ns, _change_port(frame.data), 2000) for frame in received_frames[half:]]
    reason = _reason((sent_frames, [*received_frames[:half], *translated]), Protocol.UDP)
    assert reason
    assert reason.endswith(TRANSLATED)


def test_packets_missing_in_the_senders_capture_are_reported() -> None:
    sent_frames, received_frames = _udp(lambda packet: packet)
    assert str(_reason((sent_frames[60:], received_frames), Protocol.UDP)).endswith(CHANGED)


@pytest.mark.parametrize("protocol", Protocol)
def test_packets_captured_on_two_interfaces_are_reported(protocol: Protocol) -> None:
    """As with `-i any` if packets pass a bridge or a VLAN: they would appear as lost or retransmitted."""
    sent_frames, received_frames = (
        _udp(lambda packet: packet) if protocol is Protocol.UDP else _tcp(lambda packet: packet)
    )
    duplicated = [packet for frame in sent_frames for packet in (frame, replace(frame, time_ns=frame.time_ns + 5000))]
    reason = _reason((duplicated, received_frames), protocol)
    assert reason
    assert "in the sender's capture occur twice" in reason
    assert _reason((sent_frames, [*received_frames, *received_frames]), protocol) is None, (
        "a link may duplicate packets"
    )


@pytest.mark.parametrize("end", ["sender", "receiver"])
@pytest.mark.parametrize(
    ("protocol", "snap_length"), [(Protocol.UDP, 2), (Protocol.UDP, 4), (Protocol.TCP, 2), (Protocol.TCP, 8)]
)
def test_a_snap_length_within_the_headers_does_not_appear_as_loss(
    protocol: Protocol, snap_length: int, end: str
) -> None:
    """Without ports all packets would appear lost or never sent; without sequence numbers TCP has no payload."""
    sent_frames, received_frames = (
        _udp(lambda packet: packet) if protocol is Protocol.UDP else _tcp(lambda packet: packet)
    )
    cut_packets = [
        replace(packet, data=packet.data[: 20 + snap_length])
        for packet in (sent_frames if end == "sender" else received_frames)
    ]
    reason = _reason((cut_packets, received_frames) if end == "sender" else (sent_frames, cut_packets), protocol)
    assert reason
    assert re.fullmatch(rf"the {end}'s capture has \d+ packets truncated in the TCP or UDP header", reason)


def test_similar_traffic_is_not_mistaken_for_a_translation() -> None:
    sent_frames, received_frames = _udp(lambda packet: packet)
    other_stream = timed([packet for number in range(36) for packet in datagram(900 + number, 700, sport=9)])
    packets_of_another_robot = [Frame(frame.time_ns, _change_source(frame.data), 2000) for frame in other_stream]
    packets_translated_at_receiver = [
        Frame(frame.time_ns, _change_target(frame.data), 2000) for frame in received_frames
    ]
    for name, captures in {
        "nothing": (sent_frames, received_frames),
        "all packets were lost": (sent_frames, []),
        "another robot sends to the port": (sent_frames, [*received_frames, *packets_of_another_robot]),
        "another robot sends, and all packets were lost": (sent_frames, packets_of_another_robot),
        "the receiver translates, and captures both packets": (
            sent_frames,
            [*received_frames, *packets_translated_at_receiver],
        ),
        "a packet of earlier traffic": (sent_frames, [*received_frames, *timed(datagram(999, 10))]),
        "a packet of earlier traffic, and all packets were lost": (sent_frames, timed(datagram(999, 10, sport=9))),
        "the transfer was not captured": ([], received_frames),
    }.items():
        assert _reason(captures, Protocol.UDP) is None, name


@given(st.integers(0, 2**32), st.sampled_from((1, 40)), st.booleans(), st.booleans())
@settings(max_examples=30)
def test_losses_copies_and_reordering_are_not_mistaken_for_a_translation(
    seed: int, offload: int, ids: bool, has_time_stamps: bool
) -> None:
    link = Link(seed, loss=0.3, copied=0.1, late=0.1)
    truth = links.tcp(link, 60, ids=ids, offload=offload, again=0.1, stamped=has_time_stamps)
    assert _reason((truth.sender, truth.receiver), Protocol.TCP) is None


@pytest.mark.parametrize("translation", TRANSLATIONS)
@pytest.mark.parametrize("protocol", Protocol)
def test_captures_that_cannot_be_compared_give_no_counts(
    tmp_path: Path, translation: str, protocol: Protocol
) -> None:
    change, _ = TRANSLATIONS[translation]
    sent_frames, received_frames = _udp(change) if protocol is Protocol.UDP else _tcp(change)
    (tmp_path / "sender.pcap").write_bytes(file_bytes(sent_frames))
    (tmp_path / "receiver.pcap").write_bytes(file_bytes(received_frames))
    measures = measure(tmp_path, transfer(protocol))
    assert TRANSLATED in measures.one_way_withheld
    layers = ("ip_", "datagram", "byte_", "tcp_", "paper_received", "paper_loss", "jitter", "transfer_s")
    assert not [name for name in measures if name.startswith(layers)]
    assert fates.read(AttemptEvidence(tmp_path), transfer(protocol)) is None
    other_measures = measure(tmp_path, replace(transfer(protocol), port=9))
    assert not other_measures.ip_packets_sent


def _with_planned_addresses(packet: bytes) -> bytes:
    """Return the packet with the addresses of the robots in the plan, 10.42.0.1 and 10.42.0.2."""
    return _with_field(16, ">I", 0x0A2A0002)(_with_field(12, ">I", 0x0A2A0001)(packet))


def test_a_repeat_with_translated_addresses_is_void(tmp_path: Path) -> None:
    plan = los_plan(protocols=(Protocol.UDP,))
    sent_frames, received_frames = _udp(lambda packet: _change_source(_with_planned_addresses(packet)))
    (tmp_path / "sender.pcap").write_bytes(
        file_bytes([Frame(frame.time_ns, _with_planned_addresses(frame.data)) for frame in sent_frames])
    )
    (tmp_path / "receiver.pcap").write_bytes(file_bytes(received_frames))
    (tmp_path / "recv.bag").write_bytes(b"x")
    reasons = problems(plan, Protocol.UDP, tmp_path)
    assert [reason for reason in reasons if "left as 10.42.0.1:40000 > 10.42.0.2:1234" in reason], reasons
    (tmp_path / "receiver.pcap").write_bytes(file_bytes([]))
    reasons = problems(plan, Protocol.UDP, tmp_path)
    assert [reason for reason in reasons if "recv.bag is not empty, but the capture of" in reason], reasons
