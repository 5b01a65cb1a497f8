"""A small synthetic trial on disk whose packets, replies and journal entries are known."""

import struct
from collections.abc import Callable, Sequence
from pathlib import Path

from fieldkit.core.model import Protocol, Status
from fieldkit.trial import journal, store
from fieldkit.trial.journal import Attempt, JournalEntry
from fieldkit.trial.plan import Plan
from fieldkit.trial.stored import rebuild
from tests.helpers.captures import Frame, file_bytes, ipv4
from tests.helpers.casts import CAST, los_plan, plain_plan

START_NS = 1_700_000_000_000_000_000
SECOND_NS = 1_000_000_000
# Offset of the receiver's clock.
AHEAD_NS = 3600 * SECOND_NS
SENDER, RECEIVER = (robot.address for robot in list(CAST.values())[:2])
PACKETS = 40
LOST = (3, 4, 17)
"""Numbers of the packets that do not arrive."""
REPEATED = 8
"""Number of the packet that arrives twice."""
RTT_MS = (4.5, 3.25, 12.0)

PING_HEAD = f"PING {RECEIVER} ({RECEIVER}) 8192(8220) bytes of data."
PING_TAIL = "10 packets transmitted, 3 received, 70% packet loss, time 1800ms"


def packet(number: int) -> bytes:
    """A UDP datagram of the transfer, unfragmented, without its payload."""
    header = struct.pack(">HHHH", 40000, 1234, 1008, 0)
    return ipv4(header, protocol=17, size=1008, ip_id=number, src=SENDER, dst=RECEIVER)


def segment(number: int, payload_bytes: int) -> bytes:
    """A TCP segment of the transfer, without its payload."""
    header = struct.pack(">HHIIBBHHH", 40000, 1234, number * payload_bytes, 0, 0x50, 0x10, 502, 0, 0)
    return ipv4(header, protocol=6, size=20 + payload_bytes, src=SENDER, dst=RECEIVER)


def make(out: Path, *, packets: int = PACKETS, lost: Sequence[int] = LOST) -> Path:
    """Write the folder of a trial with one repeat whose first attempt is void."""
    from tests.ros.bags.test_measure_bag import write_bag  # noqa: PLC0415 (copies of the repository without ROS do not have this module)

    plan = los_plan(repeats=1, protocols=(Protocol.UDP,), record_s=2.0)
    return make_of(
        plan, out, lambda folder: write_bag(folder / "scan.bag", {"/scan": 11}), packets=packets, lost=lost
    )


def make_plain(out: Path) -> Path:
    """Write the folder of a trial as `make` does, but with a trial that sends a generated file in place of a bag."""
    plan = plain_plan(repeats=1, protocols=(Protocol.UDP,))
    return make_of(plan, out, lambda folder: (folder / "send.bin").write_bytes(bytes(100_000)))


def make_of(
    plan: Plan,
    out: Path,
    write_sent: Callable[[Path], object],
    *,
    packets: int = PACKETS,
    lost: Sequence[int] = LOST,
) -> Path:
    """Write the folder of a trial; `write_sent` writes the sent file into the folder of an attempt."""
    folder = store.create(out, plan)
    (repeat,) = plan.repeats_in_order()
    void = Attempt(repeat, 1, START_NS, Status.VOID, "ping.txt is missing")
    valid = Attempt(repeat, 2, START_NS + 10 * SECOND_NS, Status.VALID)
    entries = [JournalEntry(START_NS - SECOND_NS, repeat.protocol, 1, 0, Status.PLANNED)]
    for attempt in (void, valid):
        started = JournalEntry(attempt.started_utc_ns, repeat.protocol, 1, attempt.number, Status.RUNNING)
        entry = JournalEntry(
            started.utc_ns + 5 * SECOND_NS, repeat.protocol, 1, attempt.number, attempt.status, attempt.reason
        )
        entries += [started, entry]
    journal.append(folder, *entries)
    (folder / store.REPEATS / void.folder).mkdir()
    write_evidence(folder / store.REPEATS / valid.folder, valid.started_utc_ns, packets, lost)
    write_sent(folder / store.REPEATS / valid.folder)
    rebuild.rebuild(folder)
    return folder


def write_evidence(folder: Path, start_ns: int, packets: int, lost: Sequence[int]) -> None:
    """Write the evidence of a repeat: the transfer starts after 2 s, the ping after 3 s; one packet arrives twice."""
    folder.mkdir()
    (folder / "recv.bag").touch()
    sent_frames = [
        Frame(start_ns + 2 * SECOND_NS + 1_000_000 * index, packet(index), 1042) for index in range(packets)
    ]
    received_frames = [
        Frame(frame.time_ns + AHEAD_NS, frame.data, 1042)
        for index, frame in enumerate(sent_frames)
        if index not in lost
    ]
    received_frames.append(Frame(received_frames[-1].time_ns + 1_000_000, packet(REPEATED), 1042))
    (folder / "sender.pcap").write_bytes(file_bytes(sent_frames))
    (folder / "receiver.pcap").write_bytes(file_bytes(received_frames))
    replies = [
        f"[{start_ns // SECOND_NS + 3}.{200_000 * (seq - 1):06}] 8200 bytes from {RECEIVER}: icmp_seq={seq} ttl=64 "
        f"time={rtt_ms:.3f} ms"
        for seq, rtt_ms in enumerate(RTT_MS, start=1)
    ]
    problem = f"[{start_ns // SECOND_NS + 3}.900000] From {SENDER} icmp_seq=4 Destination Host Unreachable"
    text = "\n".join([PING_HEAD, *replies, problem, PING_TAIL])
    (folder / "ping.txt").write_text(text, encoding="utf-8")
