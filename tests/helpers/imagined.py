"""Robots that do what command lines say, without robots: the evidence that they leave, and the truth about it.

Nothing here uses the code under test, but for the command lines themselves. Captures are filtered by the real tcpdump
with the filter of the job, so a filter that misses packets misses them here too.
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
from tests.measure.evidence.test_measure_bag import write_bag

_START_NS = 1_700_000_000_000_000_000
_HOP_NS = 2_000_000
_ALONE = 0
"""The clock of steps beside which no other runs."""
_SNMP = "==> /proc/net/snmp <==\nIp: ReasmFails\nIp: 0\nUdp: RcvbufErrors\nUdp: {}\n"
REFUSED = 3
"""Datagrams that the socket buffers of each robot refused in an attempt."""
_LISTENING = "tcpdump: listening on wlan0, link-type RAW (Raw IP), snapshot length 128 bytes\n"
_COUNTERS = "{0} packets captured\n{0} packets received by filter\n0 packets dropped by kernel\n"


@dataclass
class Sent:
    """What really happened to a transfer."""

    source: str
    target: str
    ports: tuple[int, int]
    packets_sent: int = 0
    packets_lost: int = 0
    retransmitted: int = 0
    sent_bytes: int = 0
    received_bytes: int = 0


@dataclass
class Truth:
    """What really happened to each transfer of an attempt, and to each ping, by the names of their steps.

    Attributes:
        transfers: The transfers.
        pings: How many requests were sent, and answered.
        loads: How many data packets of each iperf3 were sent, and arrived.
        cookies_bytes: What goes the way of its data before them, and is never lost: the cookie of a TCP client.
        udp_to: The address that each flow of UDP went to.
    """

    transfers: dict[str, Sent] = field(default_factory=dict)
    pings: dict[str, tuple[int, int]] = field(default_factory=dict)
    loads: dict[str, tuple[int, int]] = field(default_factory=dict)
    cookies_bytes: dict[str, int] = field(default_factory=dict)
    udp_to: list[str] = field(default_factory=list)


@dataclass
class Attempt:
    """One attempt played."""

    plan: Plan
    repeat: RepeatId
    folder: Path
    loss: float
    draw: random.Random
    truth: Truth = field(default_factory=Truth)

    def play(self) -> Truth:
        """Write the evidence of every step and return the truth."""
        self._now_ns = {_ALONE: _START_NS}
        self._ids = count(1)
        self._scene = self.plan.scene(self.repeat, "folder")
        self._crossed: list[tuple[Frame, Frame | None, str, str, tuple[int, ...]]] = []
        captures: list[tuple[int, Planned]] = []
        for placed in self.plan.procedure.walk():
            open_now = tuple(map(id, placed.within))
            self._clock = self._clock_of(placed)
            for planned in self._own(list(placed.step.jobs(self._scene)), placed.step):
                if planned.job.name.endswith("capture"):
                    captures.append((id(placed.step), planned))
                else:
                    self._do(planned, open_now)
        for nest, planned in captures:
            self._capture(nest, planned)
        for role in FIXED_ROLES:
            for moment in ("before", "after"):
                refused = REFUSED if moment == "after" else 0
                (self.folder / f"{role}-{moment}.txt").write_text(_SNMP.format(refused), encoding="ascii")
        return self.truth

    def _clock_of(self, placed: PlacedStep) -> int:
        """Which clock a step goes by: each of those that run at the same time has its own from their beginning on."""
        steps = (*placed.within, placed.step)
        parallel = [index for index, nest in enumerate(placed.within) if nest.parallel]
        if not parallel:
            self._now_ns = {_ALONE: max(self._now_ns.values())}
            return _ALONE
        clock = id(steps[parallel[-1] + 1])
        self._now_ns.setdefault(clock, self._now_ns[_ALONE] + 10_000 * len(self._now_ns))
        return clock

    def _tick(self) -> int:
        self._now_ns[self._clock] += 1_000_000
        return self._now_ns[self._clock]

    def _do(self, planned: Planned, nests: tuple[int, ...]) -> None:
        match planned.job.name.rpartition(".")[2].partition("-")[0]:
            case "record":
                self._record(planned.job)
            case "listen":
                self._listening = planned
            case "send":
                self._send(planned, self._listening, nests)
            case "ping":
                self._ping(planned.job, nests)
            case "iperf3":
                if planned.job.name.endswith("server"):
                    self._serving = planned
                else:
                    self._iperf3(planned, self._serving, nests)
            case "fault":
                self._fault(planned.job)
            case other:
                raise AssertionError(other)

    def _own(self, planned: list[Planned], step: object) -> list[Planned]:
        """The jobs of a step itself: those of the steps inside come by themselves."""
        inside = [one.job for entry in getattr(step, "during", ()) for one in entry.step.jobs(self._scene)]
        return [one for one in planned if one.job not in inside]

    def _path(self, name: str | None) -> Path:
        assert name
        path = self.folder / name
        assert not path.exists(), f"{name} is written twice"
        path.parent.mkdir(exist_ok=True)
        return path

    def _record(self, job: Job) -> None:
        words = job.argv
        stem = words[words.index("-O") + 1]
        write_bag(self._path(f"{stem}.bag"), {"/scan": 60})

    def _cross(self, data: bytes, source: str, to: str, nests: tuple[int, ...], *, lost: bool = False) -> int:
        """Let a packet leave, and arrive if it is not lost; return when it left."""
        at_ns = self._tick()
        came = None if lost else Frame(at_ns + _HOP_NS, data, wire_bytes=65_555)
        self._crossed.append((Frame(at_ns, data, wire_bytes=65_555), came, source, to, nests))
        return at_ns

    def _send(self, sending: Planned, listening: Planned, nests: tuple[int, ...]) -> None:
        assert sending.job.stdin
        content = (self.folder / sending.job.stdin).read_bytes()
        source = self._address(sending.role)
        target, port = sending.job.argv[-2], int(sending.job.argv[-1])
        assert target == self._address(listening.role)
        assert str(port) in listening.job.argv
        ports = (40_000 + len(self.truth.transfers), port)
        sent = Sent(source, target, ports, sent_bytes=len(content))
        self.truth.transfers[sending.job.name.rpartition(".")[0]] = sent
        self.truth.udp_to += [target] if "-u" in sending.job.argv else []
        deliver = self._udp if "-u" in sending.job.argv else self._tcp
        received = deliver(sent, content, nests)
        sent.received_bytes = len(received)
        self._path(listening.job.stdout).write_bytes(received)

    def _udp(self, sent: Sent, content: bytes, nests: tuple[int, ...]) -> bytes:
        received = b""
        for start in range(0, len(content), 8192):
            piece = content[start : start + 8192]
            whole = True
            for data in _fragments(next(self._ids), len(piece), sent):
                lost = self.draw.random() < self.loss
                self._cross(data, sent.source, sent.target, nests, lost=lost)
                sent.packets_sent += 1
                sent.packets_lost += lost
                whole = whole and not lost
            received += piece if whole else b""
        return received

    def _tcp(self, sent: Sent, content: bytes, nests: tuple[int, ...]) -> bytes:
        def cross(seq: int, size: int, flags: int = 0x10, *, back: bool = False, lost: bool = False) -> None:
            ports = sent.ports[::-1] if back else sent.ports
            head = struct.pack(">HHIIBBHHH", *ports, seq, 0, 5 << 4, flags, 502, 0, 0)
            ends = (sent.target, sent.source) if back else (sent.source, sent.target)
            data = ipv4(head, protocol=6, size=20 + size, ip_id=next(self._ids), src=ends[0], dst=ends[1])
            self._cross(data, *ends, nests, lost=lost)

        cross(999, 0, 0x02)
        cross(5000, 0, 0x12, back=True)
        again = []
        for start in range(0, len(content), 1448):
            size = min(1448, len(content) - start)
            lost = self.draw.random() < self.loss
            cross(1000 + start, size, lost=lost)
            cross(5001, 0, back=True)
            again += [(start, size)] if lost else []
        for start, size in again:
            cross(1000 + start, size)
        sent.retransmitted = len(again)
        return content

    def _ping(self, job: Job, nests: tuple[int, ...]) -> None:
        words = job.argv
        target, asked, payload = words[-1], int(words[words.index("-c") + 1]), int(words[words.index("-s") + 1])
        name, _, log = job.log.removesuffix(".log").rpartition(".")
        source = next(self._address(role) for role in FIXED_ROLES if log == f"{role}-ping")
        answered, identifier = 0, struct.pack(">H", len(self.truth.pings))
        lines = [f"PING {target} ({target}) {payload}({payload + 28}) bytes of data."]
        for number in range(1, asked + 1):
            lost = self.draw.random() < self.loss
            echo = identifier + struct.pack(">H", number)
            asked_ns = self._echo(bytes((8, 0, 0, 0)) + echo, payload, (source, target), nests, lost=lost)[0]
            if not lost:
                replied_ns = self._echo(bytes(4) + echo, payload, (target, source), nests)[-1] + _HOP_NS
                at_ns = replied_ns + 100_000
                stamp = f"[{at_ns // 10**9}.{at_ns % 10**9 // 1000:06d}]"
                timed = f" time={(replied_ns - asked_ns) / 1e6:.2f} ms" if payload >= 16 else ""
                lines.append(f"{stamp} {payload + 8} bytes from {target}: icmp_seq={number} ttl=64{timed}")
                answered += 1
        self.truth.pings[name] = (asked, answered)
        lines += [f"{asked} packets transmitted, {answered} received, 0% packet loss, time 1ms", ""]
        self._path(job.stdout).write_text("\n".join(lines), encoding="ascii")

    def _echo(
        self, head: bytes, payload: int, ends: tuple[str, str], nests: tuple[int, ...], *, lost: bool = False
    ) -> list[int]:
        """Let the fragments of an echo cross; return when each left."""
        ip_id, size = next(self._ids), payload + 8
        times_ns = []
        for offset in range(0, size, 1480):
            part = min(1480, size - offset)
            cut: dict[str, Any] = {"size": part, "ip_id": ip_id, "offset": offset, "more": offset + part < size}
            data = ipv4(head if offset == 0 else b"", protocol=1, src=ends[0], dst=ends[1], **cut)
            times_ns.append(self._cross(data, *ends, nests, lost=lost))
        return times_ns

    def _iperf3(self, client: Planned, server: Planned, nests: tuple[int, ...]) -> None:
        words, ends = client.job.argv, (self._address(client.role), self._address(server.role))
        ports = (50_000 + len(self.truth.loads), int(words[words.index("-p") + 1]))
        name, udp, number = client.job.name.rpartition(".")[0], "-u" in words, 20
        if not udp:
            self._cross(_segment(0x02, 0, ports, ends, next(self._ids)), *ends, nests)
            self._cross(_segment(0x12, 0, ports[::-1], ends[::-1], next(self._ids)), *ends[::-1], nests)
        cookie_bytes = 0 if udp or "-R" in words else 37
        if cookie_bytes:
            self._cross(_segment(0x10, cookie_bytes, ports, ends, next(self._ids), seq=1), *ends, nests)
        if "-R" in words:
            ports, ends = ports[::-1], ends[::-1]
        arrived = 0
        for at in range(number):
            lost = self.draw.random() < self.loss
            arrived += not lost
            head = struct.pack(">HHHH", *ports, 1408, 0)
            data = (
                ipv4(head, protocol=17, size=1408, ip_id=next(self._ids), src=ends[0], dst=ends[1])
                if udp
                else _segment(0x10, 1400, ports, ends, next(self._ids), seq=1 + cookie_bytes + 1400 * at)
            )
            self._cross(data, *ends, nests, lost=lost)
        self.truth.loads[name] = (number, arrived)
        self.truth.cookies_bytes[name] = cookie_bytes
        self.truth.udp_to += [ends[1]] if udp else []
        lasted_s = float(words[words.index("-t") + 1]) if "-t" in words else 1.0
        for planned in (client, server):
            sends = self._address(planned.role) == ends[0]
            own, other = ports if sends else ports[::-1]
            total = {"seconds": lasted_s, "bytes": 1400 * (number if sends else arrived)}
            start = {"connected": [{"local_port": own, "remote_port": other}]}
            said = {"start": start, "intervals": [{"sum": total}], "end": {}}
            self._path(planned.job.stdout).write_text(json.dumps(said), encoding="ascii")

    def _fault(self, job: Job) -> None:
        """The observer saw the robot go for 3 s, and the cause lasted 1 s."""
        if job.name.endswith("-heals"):
            self._path(job.stdout).write_text("lasted_s 1.000\ninterval_s 0.1\n", encoding="ascii")
        elif job.log.endswith("-watch.txt"):
            self._path(job.log).write_text("1.0 up 7\n1.1\n4.0 up 8\n4.1 up 8\n", encoding="ascii")
        else:
            answered = (*range(1, 11), *range(41, 51))
            replies = [
                f"[17000000{3 * (number > 40):02d}.{number:02d}0000] 64 bytes from 1.2.3.4: icmp_seq={number} ttl=64"
                for number in answered
            ]
            lines = [
                "PING 1.2.3.4 (1.2.3.4) 56(84) bytes of data.",
                *replies,
                "50 packets transmitted, 20 received, .",
                "",
            ]
            self._path(job.log).write_text("\n".join(lines), encoding="ascii")

    def _capture(self, nest: int, planned: Planned) -> None:
        mine = self._address(planned.role)
        frames = []
        for sent, came, source, to, nests in self._crossed:
            if nest in nests:
                frames += [sent] if source == mine else [came] if to == mine and came else []
        every, kept = self.folder / ".all.pcap", self._path(planned.job.argv[planned.job.argv.index("-w") + 1])
        every.write_bytes(file_bytes(sorted(frames, key=lambda frame: frame.time_ns), nano=True))
        command = ["tcpdump", "-n", "-r", str(every), "-w", str(kept), planned.job.argv[-1]]
        said = subprocess.run(command, capture_output=True, text=True, check=True)
        every.unlink()
        counted = _frames_in(kept.read_bytes())
        assert "reading from" in said.stderr
        self._path(planned.job.log).write_text(_LISTENING + _COUNTERS.format(counted), encoding="ascii")

    def _address(self, role: Role) -> str:
        return self._scene.robot(role).address


def _segment(
    flags: int, size: int, ports: tuple[int, ...], ends: tuple[str, ...], ip_id: int, *, seq: int = 0
) -> bytes:
    """A TCP segment with so much payload."""
    head = struct.pack(">HHIIBBHHH", *ports, seq, 0, 5 << 4, flags, 502, 0, 0)
    return ipv4(head, protocol=6, size=20 + size, ip_id=ip_id, src=ends[0], dst=ends[1])


def _fragments(ip_id: int, payload_bytes: int, sent: Sent) -> list[bytes]:
    """The IP packets of a UDP datagram at an MTU of 1500."""
    left = payload_bytes + 8
    cut = []
    for offset in range(0, left, 1480):
        size = min(1480, left - offset)
        head = struct.pack(">HHHH", *sent.ports, left, 0) if offset == 0 else b""
        more = offset + size < left
        cut.append(
            ipv4(
                head, protocol=17, size=size, ip_id=ip_id, offset=offset, more=more, src=sent.source, dst=sent.target
            )
        )
    return cut


def _frames_in(content: bytes) -> int:
    at, found = 24, 0
    order = "<" if content[:4] in {b"\x4d\x3c\xb2\xa1", b"\xd4\xc3\xb2\xa1"} else ">"
    while at < len(content):
        at += 16 + struct.unpack_from(f"{order}I", content, at + 8)[0]
        found += 1
    return found
