"""Packets of an earlier attempt make an attempt void; other packets at the beginning or end of a capture do not."""

import random
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fieldkit.core.model import Protocol
from fieldkit.trial.stored import plans
from tests.helpers.plans import problems
from tests.helpers.stored_trials import TRIALS
from tests.trial.test_trial_contradictions import LOSSLESS, Attempt, Packet, copy_attempt

EARLIER = "packets of an earlier attempt were still in transit"
LENGTHS_BYTES = 8
"""Bytes of the two lengths of a record; its IP packet follows them, because the captures have link type RAW."""
REPEATS = sorted(TRIALS.glob("*/repeats/*-0[0-9]"))

Filter = Callable[[bytes], bool]


def _is_icmp(packet: bytes) -> bool:
    return packet[9] == 1


def _is_later(packet: bytes) -> bool:
    return int.from_bytes(packet[6:8], "big") & 0x1FFF > 0


def _is_echo(packet: bytes) -> bool:
    return _is_icmp(packet) and not _is_later(packet)


def _is_later_echo(packet: bytes) -> bool:
    return _is_icmp(packet) and _is_later(packet)


def _is_load(packet: bytes) -> bool:
    """Return True for a packet with data of the transfer: the first fragment of a datagram, or a TCP segment."""
    return not _is_icmp(packet) and not _is_later(packet) and int.from_bytes(packet[2:4], "big") > 60


def _is_other(packet: bytes) -> bool:
    return not _is_icmp(packet) and not _is_load(packet)


def _own_packets(packets: list[Packet], role: str, is_selected: Filter) -> list[Packet]:
    """Return the selected packets that the robot in `role` sent; the sender sent the first packet of each capture."""
    sender = packets[0][1][LENGTHS_BYTES + 12 : LENGTHS_BYTES + 16]
    return [
        packet
        for packet in packets
        if (packet[1][LENGTHS_BYTES + 12 : LENGTHS_BYTES + 16] == sender) == (role == "sender")
        and is_selected(packet[1][LENGTHS_BYTES:])
    ]


def _delayed_packets(attempt: Attempt, role: str, is_selected: Filter) -> list[Packet]:
    """Return packets from another repeat, with times as if they had been delayed until the start of this attempt."""
    other = Attempt(LOSSLESS / "repeats" / f"{attempt.protocol}-02", attempt.protocol)
    start_us, _ = attempt.packets("receiver.pcap")[0]
    actual = [(start_us, rest) for _, rest in _own_packets(other.packets(f"{role}.pcap"), role, is_selected)]
    assert actual
    return actual


def _changed(packet: Packet, at: int, replacement: bytes) -> Packet:
    time_us, rest = packet
    return time_us, rest[: LENGTHS_BYTES + at] + replacement + rest[LENGTHS_BYTES + at + len(replacement) :]


def _reasons(attempt: Attempt) -> list[str]:
    return [reason for reason in attempt.problems() if EARLIER in reason]


@pytest.mark.parametrize("path", REPEATS, ids=lambda path: f"{path.parents[1].name[:16]} {path.name}")
def test_stored_repeats_stay_valid(path: Path) -> None:
    assert problems(plans.read_plan(path.parents[1]), Protocol(path.name.split("-")[0]), path) == ()


@pytest.mark.parametrize("count", [1, 10])
@pytest.mark.parametrize("protocol", Protocol)
@pytest.mark.parametrize(
    ("role", "is_selected"),
    [("sender", _is_echo), ("receiver", _is_echo), ("sender", _is_load)],
    ids=["requests", "replies", "transfer"],
)
def test_packets_of_an_earlier_attempt_make_an_attempt_void(
    tmp_path: Path, protocol: Protocol, role: str, is_selected: Filter, count: int
) -> None:
    attempt = copy_attempt(protocol, tmp_path)
    delayed_packets = _delayed_packets(attempt, role, is_selected)[:count]
    destination = "receiver" if role == "sender" else "sender"
    attempt.change_capture(destination, lambda packets: [*delayed_packets, *packets])
    (reason,) = attempt.problems()
    assert reason.startswith(f"{EARLIER}: {len(delayed_packets)} packet")


@pytest.mark.parametrize("protocol", Protocol)
def test_earlier_packets_queued_at_the_sender_make_an_attempt_void(tmp_path: Path, protocol: Protocol) -> None:
    """Both captures contain the earlier packet: a datagram, or a SYN of TCP."""
    attempt = copy_attempt(protocol, tmp_path)
    is_selected = _is_load if protocol is Protocol.UDP else lambda packet: packet[9] == 6 and packet[33] == 2
    delayed_packets = _delayed_packets(attempt, "sender", is_selected)[:1]
    for role in ("sender", "receiver"):
        attempt.change_capture(role, lambda packets: [*delayed_packets, *packets])
    (reason,) = attempt.problems()
    assert reason == f"{EARLIER}: 1 packet to the transfer's port left before the transfer started"


def test_fragments_without_a_first_fragment_make_an_attempt_void(tmp_path: Path) -> None:
    attempt = copy_attempt(Protocol.UDP, tmp_path)
    delayed_packets = _delayed_packets(attempt, "sender", _is_later_echo)
    attempt.change_capture("receiver", lambda packets: [*delayed_packets[:3], *packets])
    (reason,) = attempt.problems()
    assert reason.startswith(f"{EARLIER}: 3 packets of a ping")


@pytest.mark.parametrize("is_selected", [_is_load, _is_icmp], ids=["transfer", "pings"])
def test_an_attempt_in_which_only_earlier_packets_arrived_is_void(tmp_path: Path, is_selected: Filter) -> None:
    attempt = copy_attempt(Protocol.UDP, tmp_path)
    delayed_packets = _delayed_packets(attempt, "sender", is_selected)
    attempt.change_capture("receiver", lambda _: (delayed_packets * 5)[:9])
    attempt.change_capture("sender", lambda packets: _own_packets(packets, "sender", lambda _: True))
    (attempt.folder / "recv.bag").write_bytes(b"")
    sent = "10 packets transmitted, 0 received, 100% packet loss, time 1800ms\n"
    (attempt.folder / "ping.txt").write_text(f"PING 10.42.0.2 (10.42.0.2) 8192(8220) bytes of data.\n\n{sent}")
    assert len(_reasons(attempt)) == 1, attempt.problems()


@given(st.sampled_from(Protocol), st.integers(0, 2**32), st.sampled_from((0.0, 0.1, 0.6, 1.0)))
@settings(max_examples=20)
def test_losses_and_packets_at_the_edges_of_captures_do_not_make_an_attempt_void(
    protocol: Protocol, seed: int, loss: float
) -> None:
    """The receiver's capture may lack the last packets; a user's ping and stray ACKs may be among the packets."""
    draw = random.Random(seed)
    with tempfile.TemporaryDirectory() as folder:
        attempt = copy_attempt(protocol, Path(folder))
        echoes = [
            _changed(changed_packet, 24, b"\x12\x34")
            for changed_packet in _delayed_packets(attempt, "sender", _is_echo)
        ]
        stray_packets = [
            _changed(packet, 20, b"\x04\x00")
            for packet in _delayed_packets(attempt, "sender", _is_other)
        ] if protocol is Protocol.TCP else []  # fmt: skip
        sent, received = (attempt.packets(f"{role}.pcap") for role in ("sender", "receiver"))

        def with_losses(packets: list[Packet], role: str) -> list[Packet]:
            own_packets = _own_packets(packets, role, lambda _: True)
            return [packet for packet in packets if packet in own_packets or draw.random() >= loss]

        late_count = draw.randrange(3)
        sent = [*with_losses(sent, "sender"), *echoes[1:]]
        received = [*stray_packets[:2], *echoes[:2], *with_losses(received, "receiver")]
        replies = _own_packets(received, "receiver", _is_icmp)
        late_replies = replies[len(replies) - late_count :]
        attempt.change_capture("sender", lambda _: sent)
        attempt.change_capture(
            "receiver",
            lambda _: [changed_packet for changed_packet in received if changed_packet not in late_replies],
        )
        assert _reasons(attempt) == []


def test_rewritten_ip_ids_do_not_make_an_attempt_void(tmp_path: Path) -> None:
    """A header checksum of 0 is not checked."""
    attempt = copy_attempt(Protocol.UDP, tmp_path)
    attempt.change_capture(
        "receiver",
        lambda packets: [
            _changed(
                _changed(packet, 4, bytes((packet[1][LENGTHS_BYTES + 4] ^ 0x80, packet[1][LENGTHS_BYTES + 5]))),
                10,
                bytes(2),
            )
            if _is_icmp(packet[1][LENGTHS_BYTES:])
            else packet
            for packet in packets
        ],
    )
    assert attempt.problems() == ()
