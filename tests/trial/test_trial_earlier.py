"""Packets of an earlier attempt that arrive in this one make it void; legitimate packets at the edges do not."""

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
from tests.trial.test_trial_contradictions import LOSSLESS, Attempt, Packet, of

EARLIER = "packets of an earlier attempt were still in transit"
HEADS = 8
"""Offset of a record's lengths, after which its IP packet starts: the captures have link type RAW."""
REPEATS = sorted(TRIALS.glob("*/repeats/*-0[0-9]"))

Chosen = Callable[[bytes], bool]


def _is_icmp(packet: bytes) -> bool:
    return packet[9] == 1


def _is_later(packet: bytes) -> bool:
    return int.from_bytes(packet[6:8], "big") & 0x1FFF > 0


def _is_echo(packet: bytes) -> bool:
    return _is_icmp(packet) and not _is_later(packet)


def _is_later_echo(packet: bytes) -> bool:
    return _is_icmp(packet) and _is_later(packet)


def _is_load(packet: bytes) -> bool:
    """Return True for a packet of the transfer: a first fragment of UDP, or a TCP frame with payload."""
    return not _is_icmp(packet) and not _is_later(packet) and int.from_bytes(packet[2:4], "big") > 60


def _own_packets(packets: list[Packet], role: str, chosen: Chosen) -> list[Packet]:
    """Return the packets that the robot in `role` sent; the first of each capture is the sender's."""
    sender = packets[0][1][HEADS + 12 : HEADS + 16]
    return [
        packet
        for packet in packets
        if (packet[1][HEADS + 12 : HEADS + 16] == sender) == (role == "sender") and chosen(packet[1][HEADS:])
    ]


def _waiting(attempt: Attempt, role: str, chosen: Chosen) -> list[Packet]:
    """Return packets sent in the other repeat, as if they were delayed until the start of this one."""
    other = Attempt(LOSSLESS / "repeats" / f"{attempt.protocol}-02", attempt.protocol)
    began_us, _ = attempt.packets("receiver.pcap")[0]
    actual = [(began_us, rest) for _, rest in _own_packets(other.packets(f"{role}.pcap"), role, chosen)]
    assert actual
    return actual


def _changed(packet: Packet, at: int, by: bytes) -> Packet:
    time_us, rest = packet
    return time_us, rest[: HEADS + at] + by + rest[HEADS + at + len(by) :]


def _reasons(attempt: Attempt) -> list[str]:
    return [reason for reason in attempt.problems() if EARLIER in reason]


@pytest.mark.parametrize("path", REPEATS, ids=lambda path: f"{path.parents[1].name[:16]} {path.name}")
def test_stored_repeats_stay_valid(path: Path) -> None:
    assert problems(plans.read_plan(path.parents[1]), Protocol(path.name.split("-")[0]), path) == ()


@pytest.mark.parametrize("count", [1, 10])
@pytest.mark.parametrize("protocol", Protocol)
@pytest.mark.parametrize(
    ("role", "chosen"),
    [("sender", _is_echo), ("receiver", _is_echo), ("sender", _is_load)],
    ids=["requests", "replies", "transfer"],
)
def test_packets_of_an_earlier_attempt_make_an_attempt_void(
    tmp_path: Path, protocol: Protocol, role: str, chosen: Chosen, count: int
) -> None:
    attempt = of(protocol, tmp_path)
    waiting = _waiting(attempt, role, chosen)[:count]
    to = "receiver" if role == "sender" else "sender"
    attempt.capture(to, lambda packets: [*waiting, *packets])
    (reason,) = attempt.problems()
    assert reason.startswith(f"{EARLIER}: {len(waiting)} packet")


@pytest.mark.parametrize("protocol", Protocol)
def test_earlier_packets_queued_at_the_sender_make_an_attempt_void(tmp_path: Path, protocol: Protocol) -> None:
    """The same number of datagrams of this attempt never left, so the sums agree; for TCP a SYN was queued."""
    attempt = of(protocol, tmp_path)
    chosen = _is_load if protocol is Protocol.UDP else lambda packet: packet[9] == 6 and packet[33] == 2
    waiting = _waiting(attempt, "sender", chosen)[:1]
    for role in ("sender", "receiver"):
        attempt.capture(role, lambda packets: [*waiting, *packets])
    (reason,) = attempt.problems()
    assert reason == f"{EARLIER}: 1 packet left for the transfer's port before its sender started"


def test_fragments_without_their_first_one_make_an_attempt_void(tmp_path: Path) -> None:
    attempt = of(Protocol.UDP, tmp_path)
    waiting = _waiting(attempt, "sender", _is_later_echo)
    attempt.capture("receiver", lambda packets: [*waiting[:3], *packets])
    (reason,) = attempt.problems()
    assert reason.startswith(f"{EARLIER}: 3 packets of a ping")


@pytest.mark.parametrize("chosen", [_is_load, _is_icmp], ids=["transfer", "pings"])
def test_only_earlier_packets_arrived(tmp_path: Path, chosen: Chosen) -> None:
    attempt = of(Protocol.UDP, tmp_path)
    waiting = _waiting(attempt, "sender", chosen)
    attempt.capture("receiver", lambda _: (waiting * 5)[:9])
    attempt.capture("sender", lambda packets: _own_packets(packets, "sender", lambda _: True))
    (attempt.folder / "recv.bag").write_bytes(b"")
    sent = "10 packets transmitted, 0 received, 100% packet loss, time 1800ms\n"
    (attempt.folder / "ping.txt").write_text(f"PING 10.42.0.2 (10.42.0.2) 8192(8220) bytes of data.\n\n{sent}")
    assert len(_reasons(attempt)) == 1, attempt.problems()


@given(st.sampled_from(Protocol), st.integers(0, 2**32), st.sampled_from((0.0, 0.1, 0.6, 1.0)))
@settings(max_examples=20)
def test_losses_and_packets_at_capture_edges_are_of_this_attempt(protocol: Protocol, seed: int, lost: float) -> None:
    """Two captures differ at their ends by packets in flight; a user's ping or stray ACKs run in parallel."""
    chance = random.Random(seed)
    with tempfile.TemporaryDirectory() as place:
        attempt = of(protocol, Path(place))
        echoes = [
            _changed(changed_packet, 24, b"\x12\x34") for changed_packet in _waiting(attempt, "sender", _is_echo)
        ]
        stray_packets = [
            _changed(packet, 20, b"\x04\x00")
            for packet in _waiting(attempt, "sender", lambda packet: not _is_icmp(packet) and not _is_load(packet))
        ] if protocol is Protocol.TCP else []  # fmt: skip
        sent, received = (attempt.packets(f"{role}.pcap") for role in ("sender", "receiver"))

        def carried(packets: list[Packet], role: str) -> list[Packet]:
            own_packets = _own_packets(packets, role, lambda _: True)
            return [packet for packet in packets if packet in own_packets or chance.random() >= lost]

        cut = chance.randrange(3)
        sent = [*carried(sent, "sender"), *echoes[1:]]
        received = [*stray_packets[:2], *echoes[:2], *carried(received, "receiver")]
        replies = _own_packets(received, "receiver", _is_icmp)
        late = replies[len(replies) - cut :]
        attempt.capture("sender", lambda _: sent)
        attempt.capture(
            "receiver",
            lambda _: [changed_packet for changed_packet in received if changed_packet not in late],
        )
        assert _reasons(attempt) == []


def test_rewritten_ip_ids_are_not_an_earlier_attempt(tmp_path: Path) -> None:
    """The header checksum becomes 0, which is not judged."""
    attempt = of(Protocol.UDP, tmp_path)
    attempt.capture(
        "receiver",
        lambda packets: [
            _changed(_changed(packet, 4, bytes((packet[1][HEADS + 4] ^ 0x80, packet[1][HEADS + 5]))), 10, bytes(2))
            if _is_icmp(packet[1][HEADS:])
            else packet
            for packet in packets
        ],
    )
    assert attempt.problems() == ()
