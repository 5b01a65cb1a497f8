"""Synthetic evidence of robots that execute the command lines of a plan, and the ground truth about that evidence.

Apart from the command lines, nothing here uses the code under test. The real tcpdump filters the captures with the
filter of the job, so a filter that misses packets also misses them here.
"""

import json
import random
import struct
import subprocess
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

from fieldkit.core.model import FIXED_ROLES, RepeatId, Role
from fieldkit.remote.jobs import Job
from fieldkit.steps.scene import Planned
from fieldkit.trial.plan import Plan
from fieldkit.trial.procedure import PlacedStep
from tests.helpers.captures import Frame, file_bytes, ipv4
from tests.ros.bags.test_measure_bag import write_bag

_START_NS = 1_700_000_000_000_000_000
_HOP_NS = 2_000_000
_SEQUENTIAL = 0
"""Key of the clock for steps that do not run in parallel with other steps."""
_SNMP = "==> /proc/net/snmp <==\nIp: ReasmFails\nIp: 0\nUdp: RcvbufErrors\nUdp: {}\n"
REFUSED = 3
"""Datagrams that were dropped because a socket buffer was full, for each robot in an attempt."""
_TCPDUMP_START = "tcpdump: listening on wlan0, link-type RAW (Raw IP), snapshot length 128 bytes\n"
_TCPDUMP_COUNTERS = "{0} packets captured\n{0} packets received by filter\n0 packets dropped by kernel\n"


@dataclass
class TransferTruth:
    """Ground truth about one transfer."""

    source: str
    target: str
    ports: tuple[int, int]
    packets_sent: int = 0
    packets_lost: int = 0
    retransmitted: int = 0
    sent_bytes: int = 0
    received_bytes: int = 0


@dataclass
class AttemptTruth:
    """Ground truth about the transfers, pings and loads of an attempt, by the name of their step.

    Attributes:
        transfers: The transfers.
        pings: Number of requests and number of replies.
        loads: Number of data packets that iperf3 sent, and number of them that arrived.
        cookies_bytes: Size of the cookie that a TCP client sends before the data; it is never lost.
        udp_to: Destination address of each UDP flow.
    """

    transfers: dict[str, TransferTruth] = field(default_factory=dict)
    pings: dict[str, tuple[int, int]] = field(default_factory=dict)
    loads: dict[str, tuple[int, int]] = field(default_factory=dict)
    cookies_bytes: dict[str, int] = field(default_factory=dict)
    udp_to: list[str] = field(default_factory=list)


@dataclass
class Attempt:
    """An attempt whose evidence is generated."""

    plan: Plan
    repeat: RepeatId
    folder: Path
    loss: float
    draw: random.Random
    truth: AttemptTruth = field(default_factory=AttemptTruth)

    def write_evidence_of_steps(self) -> AttemptTruth:
        """Write the evidence of each step and return the ground truth."""
        self._now_ns = {_SEQUENTIAL: _START_NS}
        self._ip_ids = count(1)
        self._scene = self.plan.scene(self.repeat, "folder")
        self._crossings: list[tuple[Frame, Frame | None, str, str, tuple[int, ...]]] = []
        captures: list[tuple[int, Planned]] = []
        for placed in self.plan.procedure.walk():
            block_ids = tuple(map(id, placed.within))
            self._clock = self._clock_of(placed)
            for planned in self._own_jobs(list(placed.step.jobs(self._scene)), placed.step):
                if planned.job.name.endswith("capture"):
                    captures.append((id(placed.step), planned))
                else:
                    self._write_evidence(planned, block_ids)
        for block_id, planned in captures:
            self._capture(block_id, planned)
        for role in FIXED_ROLES:
            for moment in ("before", "after"):
                refused_datagrams = REFUSED if moment == "after" else 0
                (self.folder / f"{role}-{moment}.txt").write_text(_SNMP.format(refused_datagrams), encoding="ascii")
        return self.truth

    def _clock_of(self, placed: PlacedStep) -> int:
        """Key of the clock of a step; each branch of a parallel block has a separate clock that starts with the
        block.
        """
        steps = (*placed.within, placed.step)
        parallel = [index for index, block in enumerate(placed.within) if block.parallel]
        if not parallel:
            self._now_ns = {_SEQUENTIAL: max(self._now_ns.values())}
            return _SEQUENTIAL
        clock = id(steps[parallel[-1] + 1])
        self._now_ns.setdefault(clock, self._now_ns[_SEQUENTIAL] + 10_000 * len(self._now_ns))
        return clock

    def _tick(self) -> int:
        self._now_ns[self._clock] += 1_000_000
        return self._now_ns[self._clock]

    def _write_evidence(self, planned: Planned, block_ids: tuple[int, ...]) -> None:
        match planned.job.name.rpartition(".")[2].partition("-")[0]:
            case "record":
                self._record(planned.job)
            case "listen":
                self._listening = planned
            case "send":
                self._send(planned, self._listening, block_ids)
            case "ping":
                self._ping(planned.job, block_ids)
            case "iperf3":
                if planned.job.name.endswith("server"):
                    self._serving = planned
                else:
                    self._iperf3(planned, self._serving, block_ids)
            case "fault":
                self._fault(planned.job)
            case other:
                raise AssertionError(other)

    def _own_jobs(self, planned: list[Planned], step: object) -> list[Planned]:
        """The jobs of the step, without the jobs of the steps inside it."""
        inner_jobs = [
            planned_job.job for entry in getattr(step, "during", ()) for planned_job in entry.step.jobs(self._scene)
        ]
        return [planned_job for planned_job in planned if planned_job.job not in inner_jobs]

    def _path(self, name: str | None) -> Path:
        assert name
        path = self.folder / name
        assert not path.exists(), f"{name} is written twice"
        path.parent.mkdir(exist_ok=True)
        return path

    def _record(self, job: Job) -> None:
        argv = job.argv
        stem = argv[argv.index("-O") + 1]
        write_bag(self._path(f"{stem}.bag"), {"/scan": 60})

    def _cross(self, data: bytes, source: str, target: str, block_ids: tuple[int, ...], *, lost: bool = False) -> int:
        """Transmit a packet; return the time at which it was sent."""
        at_ns = self._tick()
        received_frame = None if lost else Frame(at_ns + _HOP_NS, data, wire_bytes=65_555)
        self._crossings.append((Frame(at_ns, data, wire_bytes=65_555), received_frame, source, target, block_ids))
        return at_ns

    def _send(self, sender_job: Planned, listener_job: Planned, block_ids: tuple[int, ...]) -> None:
        assert sender_job.job.stdin
        content = (self.folder / sender_job.job.stdin).read_bytes()
        source = self._address(sender_job.role)
        target, port = sender_job.job.argv[-2], int(sender_job.job.argv[-1])
        assert target == self._address(listener_job.role)
        assert str(port) in listener_job.job.argv
        ports = (40_000 + len(self.truth.transfers), port)
        sent = TransferTruth(source, target, ports, sent_bytes=len(content))
        self.truth.transfers[sender_job.job.name.rpartition(".")[0]] = sent
        self.truth.udp_to += [target] if "-u" in sender_job.job.argv else []
        transfer = self._udp if "-u" in sender_job.job.argv else self._tcp
        received = transfer(sent, content, block_ids)
        sent.received_bytes = len(received)
        self._path(listener_job.job.stdout).write_bytes(received)

    def _udp(self, sent: TransferTruth, content: bytes, block_ids: tuple[int, ...]) -> bytes:
        received = b""
        for start in range(0, len(content), 8192):
            datagram = content[start : start + 8192]
            is_complete = True
            for data in _fragments(next(self._ip_ids), len(datagram), sent):
                lost = self.draw.random() < self.loss
                self._cross(data, sent.source, sent.target, block_ids, lost=lost)
                sent.packets_sent += 1
                sent.packets_lost += lost
                is_complete = is_complete and not lost
            received += datagram if is_complete else b""
        return received

    def _tcp(self, sent: TransferTruth, content: bytes, block_ids: tuple[int, ...]) -> bytes:
        def send_segment(
            seq: int, size: int, flags: int = 0x10, *, is_reply: bool = False, lost: bool = False
        ) -> None:
            ports = sent.ports[::-1] if is_reply else sent.ports
            tcp_header = struct.pack(">HHIIBBHHH", *ports, seq, 0, 5 << 4, flags, 502, 0, 0)
            ends = (sent.target, sent.source) if is_reply else (sent.source, sent.target)
            data = ipv4(tcp_header, protocol=6, size=20 + size, ip_id=next(self._ip_ids), src=ends[0], dst=ends[1])
            self._cross(data, *ends, block_ids, lost=lost)

        send_segment(999, 0, 0x02)
        send_segment(5000, 0, 0x12, is_reply=True)
        lost_segments = []
        for start in range(0, len(content), 1448):
            size = min(1448, len(content) - start)
            lost = self.draw.random() < self.loss
            send_segment(1000 + start, size, lost=lost)
            send_segment(5001, 0, is_reply=True)
            lost_segments += [(start, size)] if lost else []
        for start, size in lost_segments:
            send_segment(1000 + start, size)
        sent.retransmitted = len(lost_segments)
        return content

    def _ping(self, job: Job, block_ids: tuple[int, ...]) -> None:
        argv = job.argv
        target, request_count, payload = argv[-1], int(argv[argv.index("-c") + 1]), int(argv[argv.index("-s") + 1])
        name, _, log = job.log.removesuffix(".log").rpartition(".")
        source = next(self._address(role) for role in FIXED_ROLES if log == f"{role}-ping")
        reply_count, identifier = 0, struct.pack(">H", len(self.truth.pings))
        lines = [f"PING {target} ({target}) {payload}({payload + 28}) bytes of data."]
        for number in range(1, request_count + 1):
            lost = self.draw.random() < self.loss
            echo = identifier + struct.pack(">H", number)
            request_ns = self._echo(bytes((8, 0, 0, 0)) + echo, payload, (source, target), block_ids, lost=lost)[0]
            if not lost:
                reply_ns = self._echo(bytes(4) + echo, payload, (target, source), block_ids)[-1] + _HOP_NS
                at_ns = reply_ns + 100_000
                timestamp = f"[{at_ns // 10**9}.{at_ns % 10**9 // 1000:06d}]"
                rtt_text = f" time={(reply_ns - request_ns) / 1e6:.2f} ms" if payload >= 16 else ""
                lines.append(f"{timestamp} {payload + 8} bytes from {target}: icmp_seq={number} ttl=64{rtt_text}")
                reply_count += 1
        self.truth.pings[name] = (request_count, reply_count)
        lines += [f"{request_count} packets transmitted, {reply_count} received, 0% packet loss, time 1ms", ""]
        self._path(job.stdout).write_text("\n".join(lines), encoding="ascii")

    def _echo(
        self,
        icmp_header: bytes,
        payload: int,
        ends: tuple[str, str],
        block_ids: tuple[int, ...],
        *,
        lost: bool = False,
    ) -> list[int]:
        """Send the fragments of an echo packet; return the time at which each was sent."""
        ip_id, size = next(self._ip_ids), payload + 8
        times_ns = []
        for offset in range(0, size, 1480):
            fragment_bytes = min(1480, size - offset)
            ip_fields: dict[str, Any] = {
                "size": fragment_bytes,
                "ip_id": ip_id,
                "offset": offset,
                "more": offset + fragment_bytes < size,
            }
            data = ipv4(icmp_header if offset == 0 else b"", protocol=1, src=ends[0], dst=ends[1], **ip_fields)
            times_ns.append(self._cross(data, *ends, block_ids, lost=lost))
        return times_ns

    def _iperf3(self, client: Planned, server: Planned, block_ids: tuple[int, ...]) -> None:
        argv, ends = client.job.argv, (self._address(client.role), self._address(server.role))
        ports = (50_000 + len(self.truth.loads), int(argv[argv.index("-p") + 1]))
        name, udp, packet_count = client.job.name.rpartition(".")[0], "-u" in argv, 20
        if not udp:
            self._cross(_segment(0x02, 0, ports, ends, next(self._ip_ids)), *ends, block_ids)
            self._cross(_segment(0x12, 0, ports[::-1], ends[::-1], next(self._ip_ids)), *ends[::-1], block_ids)
        cookie_bytes = 0 if udp or "-R" in argv else 37
        if cookie_bytes:
            self._cross(_segment(0x10, cookie_bytes, ports, ends, next(self._ip_ids), seq=1), *ends, block_ids)
        if "-R" in argv:
            ports, ends = ports[::-1], ends[::-1]
        arrived_count = 0
        for index in range(packet_count):
            lost = self.draw.random() < self.loss
            arrived_count += not lost
            udp_header = struct.pack(">HHHH", *ports, 1408, 0)
            data = (
                ipv4(udp_header, protocol=17, size=1408, ip_id=next(self._ip_ids), src=ends[0], dst=ends[1])
                if udp
                else _segment(0x10, 1400, ports, ends, next(self._ip_ids), seq=1 + cookie_bytes + 1400 * index)
            )
            self._cross(data, *ends, block_ids, lost=lost)
        self.truth.loads[name] = (packet_count, arrived_count)
        self.truth.cookies_bytes[name] = cookie_bytes
        self.truth.udp_to += [ends[1]] if udp else []
        duration_s = float(argv[argv.index("-t") + 1]) if "-t" in argv else 1.0
        for planned in (client, server):
            is_data_sender = self._address(planned.role) == ends[0]
            local_port, remote_port = ports if is_data_sender else ports[::-1]
            total = {"seconds": duration_s, "bytes": 1400 * (packet_count if is_data_sender else arrived_count)}
            start = {"connected": [{"local_port": local_port, "remote_port": remote_port}]}
            output = {"start": start, "intervals": [{"sum": total}], "end": {}}
            self._path(planned.job.stdout).write_text(json.dumps(output), encoding="ascii")

    def _fault(self, job: Job) -> None:
        """Write the evidence of a fault that lasted 1 s, and after which the robot did not answer for 3 s."""
        if job.name.endswith("-heals"):
            self._path(job.stdout).write_text("lasted_s 1.000\ninterval_s 0.1\n", encoding="ascii")
        elif job.log.endswith("-watch.txt"):
            self._path(job.log).write_text("1.0 up 7\n1.1\n4.0 up 8\n4.1 up 8\n", encoding="ascii")
        else:
            answered_numbers = (*range(1, 11), *range(41, 51))
            replies = [
                f"[17000000{3 * (number > 40):02d}.{number:02d}0000] 64 bytes from 1.2.3.4: icmp_seq={number} ttl=64"
                for number in answered_numbers
            ]
            lines = [
                "PING 1.2.3.4 (1.2.3.4) 56(84) bytes of data.",
                *replies,
                "50 packets transmitted, 20 received, .",
                "",
            ]
            self._path(job.log).write_text("\n".join(lines), encoding="ascii")

    def _capture(self, block_id: int, planned: Planned) -> None:
        address = self._address(planned.role)
        frames = []
        for sent_frame, received_frame, source, target, block_ids in self._crossings:
            if block_id in block_ids:
                frames += (
                    [sent_frame]
                    if source == address
                    else [received_frame]
                    if target == address and received_frame
                    else []
                )
        all_packets, filtered = (
            self.folder / ".all.pcap",
            self._path(planned.job.argv[planned.job.argv.index("-w") + 1]),
        )
        all_packets.write_bytes(file_bytes(sorted(frames, key=lambda frame: frame.time_ns), nano=True))
        command = ["tcpdump", "-n", "-r", str(all_packets), "-w", str(filtered), planned.job.argv[-1]]
        completed = subprocess.run(command, capture_output=True, text=True, check=True)
        all_packets.unlink()
        frame_count = _frame_count(filtered.read_bytes())
        assert "reading from" in completed.stderr
        self._path(planned.job.log).write_text(
            _TCPDUMP_START + _TCPDUMP_COUNTERS.format(frame_count), encoding="ascii"
        )

    def _address(self, role: Role) -> str:
        return self._scene.robot(role).address


def _segment(
    flags: int, size: int, ports: tuple[int, ...], ends: tuple[str, ...], ip_id: int, *, seq: int = 0
) -> bytes:
    """A TCP segment with `size` payload bytes."""
    tcp_header = struct.pack(">HHIIBBHHH", *ports, seq, 0, 5 << 4, flags, 502, 0, 0)
    return ipv4(tcp_header, protocol=6, size=20 + size, ip_id=ip_id, src=ends[0], dst=ends[1])


def _fragments(ip_id: int, payload_bytes: int, sent: TransferTruth) -> list[bytes]:
    """The IP packets of a UDP datagram for an MTU of 1500 bytes."""
    datagram_bytes = payload_bytes + 8
    fragments = []
    for offset in range(0, datagram_bytes, 1480):
        size = min(1480, datagram_bytes - offset)
        udp_header = struct.pack(">HHHH", *sent.ports, datagram_bytes, 0) if offset == 0 else b""
        has_more = offset + size < datagram_bytes
        fragments.append(
            ipv4(
                udp_header,
                protocol=17,
                size=size,
                ip_id=ip_id,
                offset=offset,
                more=has_more,
                src=sent.source,
                dst=sent.target,
            )
        )
    return fragments


def _frame_count(content: bytes) -> int:
    position, count = 24, 0
    order = "<" if content[:4] in {b"\x4d\x3c\xb2\xa1", b"\xd4\xc3\xb2\xa1"} else ">"
    while position < len(content):
        position += 16 + struct.unpack_from(f"{order}I", content, position + 8)[0]
        count += 1
    return count
