"""Packets that something between the captures makes others of: seen, told, and nothing counted."""

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.core.model import Protocol
from fieldkit.measure.attempt import AttemptEvidence
from fieldkit.measure.transfers import fates, strangers
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


def _put(at: int, form: str, value: int) -> Change:
    def change(packet: bytes) -> bytes:
        whole = bytearray(packet)
        struct.pack_into(form, whole, at, value)
        return bytes(whole)

    return change


def _added(at: int, form: str, more: int) -> Change:
    def change(packet: bytes) -> bytes:
        (old,) = struct.unpack_from(form, packet, at)
        return _put(at, form, (old + more) % 256 ** struct.calcsize(form))(packet)

    return change


def _port(packet: bytes) -> bytes:
    """Only what has a port has another one: of a datagram's fragments the first."""
    return packet if packet[6:8] not in {b"\0\0", b"\x20\0", b"\x40\0"} else _put(20, ">H", 55_555)(packet)


source = _put(12, ">I", int.from_bytes(bytes((10, 9, 0, 77))))
target = _put(16, ">I", int.from_bytes(bytes((10, 9, 0, 78))))
WAYS: dict[str, tuple[Change, str]] = {
    "the source's address": (source, TRANSLATED),
    "the target's address": (target, TRANSLATED),
    "the source's address and port": (lambda one: _port(source(one)), TRANSLATED),
    "the source's port": (_port, TRANSLATED),
}


def _udp(change: Change, *, kept_of: int = 10, ip_id: int | None = None) -> tuple[list[Frame], list[Frame]]:
    """36 datagrams of six fragments, of which one in `kept_of` packets is lost."""
    cut = [one for number in range(36) for one in datagram(number if ip_id is None else ip_id, 8192)]
    sent = timed(cut)
    return sent, [
        Frame(frame.time_ns, change(frame.data), 2000) for at, frame in enumerate(sent) if at % kept_of != 3
    ]


def _tcp(change: Change, *, stamped: bool = True) -> tuple[list[Frame], list[Frame]]:
    truth = links.tcp(Link(4, loss=0.1), 200, ids=True, offload=10, stamped=stamped)
    return truth.sender, [Frame(one.time_ns, change(one.data), one.wire_bytes) for one in truth.receiver]


def _why(captures: tuple[list[Frame], list[Frame]], protocol: Protocol) -> str | None:
    sender, receiver = map(packets, captures)
    return strangers.reason(sender, receiver, transfer(protocol))


@pytest.mark.parametrize("protocol", Protocol)
@pytest.mark.parametrize("what", WAYS)
def test_a_translation_is_told(what: str, protocol: Protocol) -> None:
    change, why = WAYS[what]
    found = _why(_udp(change) if protocol is Protocol.UDP else _tcp(change), protocol)
    assert found
    assert found.endswith(why)
    assert f"as {SENDER}:40000 > {RECEIVER}:{PORT} and reached the receiver as " in found
    assert not what.endswith("port") or ":55555 > " in found


@pytest.mark.parametrize(
    "change", [_added(24, ">I", 1 << 31), _added(44, ">I", 77_777)], ids=["sequence numbers", "time stamps"]
)
def test_a_firewall_that_gives_other_numbers_is_told(change: Change) -> None:
    found = _why(_tcp(change), Protocol.TCP)
    assert found
    assert found.endswith(CHANGED)


def test_a_router_that_gives_other_ids_is_told() -> None:
    found = _why(_udp(_added(4, ">H", 30_000)), Protocol.UDP)
    assert found
    assert found.endswith(CHANGED)


def test_a_port_that_changes_in_the_middle_is_told() -> None:
    """As a router does that forgot the flow: half of the packets arrive as they were sent."""
    sent, received = _udp(lambda one: one)
    half = len(received) // 2
    later = [Frame(frame.time_ns, _port(frame.data), 2000) for frame in received[half:]]
    found = _why((sent, [*received[:half], *later]), Protocol.UDP)
    assert found
    assert found.endswith(TRANSLATED)


def test_what_the_senders_capture_lacks_is_told() -> None:
    sent, received = _udp(lambda one: one)
    assert str(_why((sent[60:], received), Protocol.UDP)).endswith(CHANGED)


@pytest.mark.parametrize("protocol", Protocol)
def test_packets_that_the_sender_captured_on_two_interfaces_are_told(protocol: Protocol) -> None:
    """As `-i any` does where packets pass a bridge or a VLAN: they would be half lost, or sent again."""
    sent, received = _udp(lambda one: one) if protocol is Protocol.UDP else _tcp(lambda one: one)
    twice = [one for frame in sent for one in (frame, replace(frame, time_ns=frame.time_ns + 5000))]
    found = _why((twice, received), protocol)
    assert found
    assert "in the sender's capture occur twice" in found
    assert _why((sent, [*received, *received]), protocol) is None, "a link may copy"


@pytest.mark.parametrize("end", ["sender", "receiver"])
@pytest.mark.parametrize(
    ("protocol", "kept"), [(Protocol.UDP, 2), (Protocol.UDP, 4), (Protocol.TCP, 2), (Protocol.TCP, 8)]
)
def test_a_snap_length_within_the_headers_makes_no_loss(protocol: Protocol, kept: int, end: str) -> None:
    """Without ports all of it seems lost, or never sent; without sequence numbers, no payload of TCP."""
    sent, received = _udp(lambda one: one) if protocol is Protocol.UDP else _tcp(lambda one: one)
    cut = [replace(one, data=one.data[: 20 + kept]) for one in (sent if end == "sender" else received)]
    found = _why((cut, received) if end == "sender" else (sent, cut), protocol)
    assert found
    assert f"in the {end}'s capture were truncated in their TCP or UDP header" in found


def test_what_looks_like_it_is_no_translation() -> None:
    sent, received = _udp(lambda one: one)
    stranger = timed([packet for number in range(36) for packet in datagram(900 + number, 700, sport=9)])
    of_another = [Frame(frame.time_ns, source(frame.data), 2000) for frame in stranger]
    translated_here = [Frame(frame.time_ns, target(frame.data), 2000) for frame in received]
    for name, captures in {
        "nothing": (sent, received),
        "all of it was lost": (sent, []),
        "another robot sends to the port": (sent, [*received, *of_another]),
        "another robot sends, and all was lost": (sent, of_another),
        "the receiver itself translates, and captures both": (sent, [*received, *translated_here]),
        "one packet of something earlier": (sent, [*received, *timed(datagram(999, 10))]),
        "one of something earlier, and all was lost": (sent, timed(datagram(999, 10, sport=9))),
        "the transfer was not captured": ([], received),
    }.items():
        assert _why(captures, Protocol.UDP) is None, name


@given(st.integers(0, 2**32), st.sampled_from((1, 40)), st.booleans(), st.booleans())
@settings(max_examples=30)
def test_a_link_that_loses_copies_and_reorders_translates_nothing(
    seed: int, offload: int, ids: bool, stamped: bool
) -> None:
    link = Link(seed, loss=0.3, copied=0.1, late=0.1)
    truth = links.tcp(link, 60, ids=ids, offload=offload, again=0.1, stamped=stamped)
    assert _why((truth.sender, truth.receiver), Protocol.TCP) is None


@pytest.mark.parametrize("what", WAYS)
@pytest.mark.parametrize("protocol", Protocol)
def test_nothing_is_counted_of_what_does_not_compare(tmp_path: Path, what: str, protocol: Protocol) -> None:
    change, _ = WAYS[what]
    sent, received = _udp(change) if protocol is Protocol.UDP else _tcp(change)
    (tmp_path / "sender.pcap").write_bytes(file_bytes(sent))
    (tmp_path / "receiver.pcap").write_bytes(file_bytes(received))
    found = measure(tmp_path, transfer(protocol))
    assert TRANSLATED in found.one_way_withheld
    layers = ("ip_", "datagram", "byte_", "tcp_", "paper_received", "paper_loss", "jitter", "transfer_s")
    assert not [name for name in found if name.startswith(layers)]
    assert fates.read(AttemptEvidence(tmp_path), transfer(protocol)) is None
    other = measure(tmp_path, replace(transfer(protocol), port=9))
    assert not other.ip_packets_sent


def _planned(packet: bytes) -> bytes:
    """Between the robots of the plan, 10.42.0.1 and 10.42.0.2."""
    return _put(16, ">I", 0x0A2A0002)(_put(12, ">I", 0x0A2A0001)(packet))


def test_a_repeat_of_which_addresses_are_translated_is_void(tmp_path: Path) -> None:
    plan = los_plan(protocols=(Protocol.UDP,))
    sent, received = _udp(lambda one: source(_planned(one)))
    (tmp_path / "sender.pcap").write_bytes(file_bytes([Frame(one.time_ns, _planned(one.data)) for one in sent]))
    (tmp_path / "receiver.pcap").write_bytes(file_bytes(received))
    (tmp_path / "recv.bag").write_bytes(b"x")
    said = problems(plan, Protocol.UDP, tmp_path)
    assert [one for one in said if "left as 10.42.0.1:40000 > 10.42.0.2:1234" in one], said
    (tmp_path / "receiver.pcap").write_bytes(file_bytes([]))
    said = problems(plan, Protocol.UDP, tmp_path)
    assert [one for one in said if "recv.bag is not empty, but the capture of" in one], said
