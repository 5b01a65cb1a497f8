"""Captures, read by scapy and tcpdump, contain the packets that each robot sent and received, exact in every bit."""

import os
import re
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from scapy.layers.inet import ICMP, IP, TCP, UDP
from scapy.packet import Packet
from scapy.utils import PcapReader

from sim_backends.cosim import build, load_scenario
from sim_backends.cosim.agents import Agents
from sim_backends.cosim.coordinator import Coordinator
from sim_backends.cosim.policies.window_policies import EventDriven
from sim_backends.cosim.programs.senders import Periodic
from sim_backends.cosim.recording.captures import CapturedFlow, Captures, IpEncoder, packets_between
from sim_backends.cosim.recording.recorder import RunRecorder
from sim_backends.cosim.recording.replay import read_recording
from sim_backends.network.disc import Disc
from sim_backends.network.ip import Fragment
from sim_backends.network.packets import Arrival, Drop
from sim_backends.network.packets import Packet as NetworkPacket
from sim_backends.network.radio import RadioNetwork
from sim_backends.network.tcp.connection import ConnectionName, Tcp
from sim_backends.network.tcp.segments import Segment
from sim_backends.network.udp import Udp
from sim_backends.network.wire import IpPacket
from sim_backends.physics.paths import Paths
from sim_backends.radio.models.fixed_links import UniformLinks
from sim_backends.radio.radio_options import RadioOptions
from sim_backends.world.motion import State, WayPoints
from tests.helpers.passing_robots import MS, SETTINGS

NAMES = ("alpha", "bravo", "carol")
ADDRESSES = {name: f"10.0.0.{number}" for number, name in enumerate(NAMES, start=1)}


@dataclass(frozen=True)
class RecordedRun:
    """A recording of a run, and the packets that the network logged.

    Attributes:
        folder: The recording.
        log: The packets that each robot sent or received, in order.
    """

    folder: Path
    log: list[tuple[int, str, Fragment]]


@pytest.fixture(scope="module")
def recorded_run(tmp_path_factory: pytest.TempPathFactory) -> RecordedRun:
    """Three robots send over links with 10 % loss: UDP in fragments, and TCP with retransmissions."""
    folder = tmp_path_factory.mktemp("captures") / "run"
    links: UniformLinks[Fragment] = UniformLinks(
        1, RadioOptions.model_validate({"delay": "5ms", "rate": "20Mbit/s", "loss": "10%"})
    )
    network = RadioNetwork(links, NAMES, transports={"udp": Udp, "tcp": Tcp})
    physics = Paths([WayPoints(name, [(0.0, 0.0, 0.0)], 1.0) for name in NAMES])
    programs = {
        "alpha": Periodic("large", "bravo", period_ns=20 * MS, size_bytes=4000),
        "bravo": Periodic("stream", "carol", period_ns=3 * MS, size_bytes=3000, protocol="tcp"),
        "carol": Periodic("small", "alpha", period_ns=7 * MS + 1, size_bytes=11),
    }
    pairs = [("alpha", "bravo"), ("bravo", "carol"), ("carol", "alpha")]
    log: list[tuple[int, str, Fragment]] = []
    with RunRecorder(folder, SETTINGS, snap_bytes=65535, part_every_s=0.02) as recorder:

        def log_and_record(at_ns: int, host: str, fragment: Fragment) -> None:
            log.append((at_ns, host, fragment))
            recorder.log_ip(at_ns, host, fragment)

        network.log_ip(log_and_record)
        Coordinator(Agents(physics, programs), network, EventDriven(), pairs, observer=recorder).advance(700 * MS)
    assert read_recording(folder).run.fates
    return RecordedRun(folder, log)


def dissect(recorded_run: RecordedRun, name: str) -> list[Packet]:
    return list(PcapReader(str(recorded_run.folder / "captures" / f"{name}.pcap")))


@pytest.mark.parametrize("name", NAMES)
def test_scapy_reads_the_packets_that_the_network_logged(recorded_run: RecordedRun, name: str) -> None:
    frames = dissect(recorded_run, name)
    logged_fragments = [(at_ns, fragment) for at_ns, host, fragment in recorded_run.log if host == name]
    assert len(frames) == len(logged_fragments) > 100
    for frame, (at_ns, fragment) in zip(frames, logged_fragments, strict=True):
        packet = fragment.packet
        assert packet.destination is not None
        ip = frame[IP]
        assert round(frame.time * 10**9) == at_ns
        assert (ip.src, ip.dst) == (ADDRESSES[packet.source], ADDRESSES[packet.destination])
        assert (ip.len, len(frame), ip.id) == (fragment.size_bytes, fragment.size_bytes, fragment.ip_id % 65536)
        assert (ip.frag * 8, "MF" in ip.flags) == (fragment.offset_bytes, fragment.index + 1 < fragment.count)
        if packet.transport == "tcp":
            check_tcp(ip[TCP], packet.body[1], is_forward=packet.source == "bravo")
        elif not fragment.index:
            assert ip[UDP].len == packet.size_bytes - 20


def check_tcp(tcp: Packet, segment: Segment, *, is_forward: bool) -> None:
    options: Mapping[str, Any] = dict(tcp.options)
    assert (tcp.seq, tcp.ack) == (segment.first, segment.acknowledges or 0)
    flags = {"S": segment.syn, "A": segment.acknowledges is not None, "P": bool(segment.length)}
    assert {flag: flag in tcp.flags for flag in flags} == flags
    assert not set(str(tcp.flags)) - set(flags)
    assert tcp.dport == 40001 if is_forward else tcp.sport == 40001, "the second flow of the run"
    assert options["Timestamp"] == (segment.sent_ns // MS, (segment.echoes_ns or 0) // MS)
    assert len(tcp.payload) == segment.length
    assert options.get("SAck", ()) == tuple(edge for block in segment.sacks for edge in block)
    if segment.syn:
        assert (options["MSS"], options["WScale"], options["SAckOK"]) == (1460, 7, b"")
        assert tcp.window == min(segment.window_bytes, 65535)
    else:
        assert tcp.window == segment.window_bytes >> 7


@pytest.mark.parametrize("name", NAMES)
def test_checksums_equal_those_that_scapy_computes(recorded_run: RecordedRun, name: str) -> None:
    packets = [frame[IP] for frame in dissect(recorded_run, name)]
    for packet in packets:
        assert packet.chksum == with_scapy_checksum(packet, IP).chksum
    unfragmented = [packet for packet in packets if not packet.frag and "MF" not in packet.flags]
    reassembled_packets = reassemble(packets)
    assert bool(reassembled_packets) == (name in {"alpha", "bravo"}), "both ends of the packets that need fragments"
    for packet in unfragmented + reassembled_packets:
        kind = TCP if TCP in packet else UDP
        assert packet[kind].chksum == with_scapy_checksum(packet, kind)[kind].chksum


def with_scapy_checksum(packet: Packet, kind: type[Packet]) -> Packet:
    """Return a packet with a checksum that scapy has computed."""
    packet_copy = IP(bytes(packet))
    del packet_copy[kind].chksum
    return IP(bytes(packet_copy))


def reassemble(packets: Sequence[Packet]) -> list[Packet]:
    """Reassemble the packets whose fragments were all captured."""
    parts: dict[tuple[str, int], dict[int, Packet]] = {}
    for packet in packets:
        if packet.frag or "MF" in packet.flags:
            parts.setdefault((packet.src, packet.id), {})[packet.frag * 8] = packet
    whole_packets: list[Packet] = []
    for fragments_by_offset in parts.values():
        last_fragment = fragments_by_offset[max(fragments_by_offset)]
        data = b"".join(bytes(fragments_by_offset[offset].payload) for offset in sorted(fragments_by_offset))
        if "MF" not in last_fragment.flags and len(data) == max(fragments_by_offset) + len(last_fragment.payload):
            whole_packets.append(
                IP(bytes(IP(src=last_fragment.src, dst=last_fragment.dst, proto=last_fragment.proto) / data))
            )
    return whole_packets


@pytest.mark.emulated
def test_tcpdump_reports_every_checksum_as_correct(recorded_run: RecordedRun) -> None:
    for name in NAMES:
        command = ["tcpdump", "-n", "-vv", "-r", str(recorded_run.folder / "captures" / f"{name}.pcap")]
        result = subprocess.run(command, capture_output=True, text=True, check=True)
        assert "link-type RAW (Raw IP)" in result.stderr
        assert not re.findall("bad|incorrect|truncated|wrong|invalid", result.stdout)
    # The last capture is that of carol, who receives bravo's TCP connection with its losses.
    assert result.stdout.count("(correct)") > 100
    assert re.search(r"options \[nop,nop,TS val \d+ ecr \d+,nop,nop,sack 1 \{\d+:\d+\}\]", result.stdout)
    assert re.search(r"Flags \[S\.\], .* options \[mss 1460,sackOK,TS val \d+ ecr \d+,nop,wscale 7\]", result.stdout)


def test_the_robots_of_a_scenario_capture_the_packets_of_their_network(tmp_path: Path) -> None:
    scenario = load_scenario("baylands")
    with RunRecorder(tmp_path / "run", SETTINGS) as recorder:
        run = build(scenario, policy="scheduled", recorder=recorder).run(2000 * MS)
    assert read_recording(tmp_path / "run").run == run
    packet_counts = {
        path.stem: len(list(PcapReader(str(path)))) for path in (tmp_path / "run" / "captures").iterdir()
    }
    assert packet_counts.keys() == scenario.agents.keys()
    arrived_count = sum(fate.arrived_ns is not None for fate in run.fates.values())
    assert sum(packet_counts.values()) >= len(run.fates) + arrived_count > 10, (
        "each packet at its sender, and at its receiver"
    )


class EveryThirdPacketLost(Disc):
    def advance(
        self, to_ns: int, packets: Sequence[NetworkPacket], states: Mapping[str, State]
    ) -> tuple[list[Arrival], list[Drop]]:
        lost_packets = [packet for packet in packets if packet.packet_id % 3 == 0]
        arrivals, _ = super().advance(to_ns, [packet for packet in packets if packet not in lost_packets], states)
        return arrivals, [Drop(packet.packet_id, "third") for packet in lost_packets]


def test_packets_of_another_network_are_captured_as_datagrams_at_both_ends(tmp_path: Path) -> None:
    scenario = load_scenario("baylands", {"duration": "2s"})
    with RunRecorder(tmp_path / "run", SETTINGS) as recorder:
        run = build(scenario, policy="scheduled", recorder=recorder, network=EveryThirdPacketLost(1e6, 3 * MS)).run()
    assert read_recording(tmp_path / "run").run == run
    assert any(fate.reason for fate in run.fates.values())
    for number, name in enumerate(sorted(scenario.agents), start=1):
        expected = [
            (fate.packet.enters_ns, fate.packet.size_bytes + 28, fate.packet.identity[0])
            for fate in run.fates.values()
            if fate.packet.source == name
        ]
        expected += [
            (fate.arrived_ns, fate.packet.size_bytes + 28, fate.packet.identity[0])
            for fate in run.fates.values()
            if fate.packet.destination == name and fate.arrived_ns is not None
        ]
        path = tmp_path / "run" / "captures" / f"{name}.pcap"
        frames = list(PcapReader(str(path))) if path.exists() else []
        times_ns = [round(frame.time * 10**9) for frame in frames]
        assert times_ns == sorted(times_ns)
        assert sorted(zip(times_ns, (frame.wirelen for frame in frames), strict=True)) == sorted(
            (at_ns, size_bytes) for at_ns, size_bytes, _ in expected
        )
        assert all(f"10.0.0.{number}" in (frame[IP].src, frame[IP].dst) for frame in frames)
        assert len({frame[UDP].dport for frame in frames}) == len({flow for *_, flow in expected})


def test_truncated_packets_have_their_original_length(tmp_path: Path) -> None:
    captures = Captures(tmp_path / "captures", NAMES, snap_bytes=60)
    packet = IpPacket("alpha", None, "topic", 1400, ("topic", 0), object())
    captures.log(1_234_567_890_123, "alpha", Fragment(packet, 65537, 0, 1, 0, 1400))
    captures.flush()
    captures.close()
    (frame,) = PcapReader(str(tmp_path / "captures" / "alpha.pcap"))
    assert (round(frame.time * 10**9), len(frame), frame.wirelen) == (1_234_567_890_123, 60, 1400)
    assert (frame[IP].dst, frame[IP].id, frame[UDP].dport) == ("239.255.0.1", 1, 7400)
    assert {path.name for path in (tmp_path / "captures").iterdir()} == {"alpha.pcap"}, "others have sent nothing"


def test_sequence_numbers_wrap_as_on_the_wire() -> None:
    segment = Segment(
        syn=False,
        first=2**32 + 5,
        length=1,
        acknowledges=2**33 + 6,
        sacks=((2**32 + 7, 2**32 + 9),),
        window_bytes=2**30,
        sent_ns=(2**32 + 3) * MS,
        echoes_ns=(2**32 + 4) * MS,
        number=0,
        earlier_transmissions=0,
    )
    body = ConnectionName("alpha", "bravo", "stream", 0), segment
    packet = IpPacket("alpha", "bravo", "tcp", segment.size_bytes, ("stream", 0), body)
    tcp = IP(IpEncoder(NAMES).encode(Fragment(packet, 0, 0, 1, 0, segment.size_bytes), 65535))[TCP]
    assert (tcp.seq, tcp.ack, tcp.window) == (5, 6, 65535)
    assert dict(tcp.options)["Timestamp"] == (3, 4)
    assert dict(tcp.options)["SAck"] == (7, 9)


@pytest.mark.parametrize("name", NAMES)
def test_a_capture_that_is_interrupted_after_a_write_has_no_packet_twice(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    captures = Captures(tmp_path / "captures", NAMES, snap_bytes=60)
    packet = IpPacket(name, "bravo", "udp", 40, ("flow", 0), 1)
    captures.log(1, name, Fragment(packet, 1, 0, 1, 0, 40))

    def write_then_interrupt(
        write: Callable[[int, bytes, int], int], descriptor: int, data: bytes, offset: int
    ) -> int:
        write(descriptor, data, offset)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("os.pwrite", partial(write_then_interrupt, os.pwrite))
        with pytest.raises(KeyboardInterrupt):
            captures.flush()
    captures.log(2, name, Fragment(packet, 2, 0, 1, 0, 40))
    captures.flush()
    captures.close()
    frames = PcapReader(str(tmp_path / "captures" / f"{name}.pcap"))
    assert [frame[IP].id for frame in frames] == [1, 2]


def test_pings_are_icmp_and_a_configured_port_is_used(tmp_path: Path) -> None:
    flows = {
        "file": CapturedFlow(port=1234),
        "ask": CapturedFlow(ping="ask"),
        "ask/reply": CapturedFlow(ping="ask", is_reply=True),
        "again": CapturedFlow(ping="again"),
    }
    captures = Captures(tmp_path / "captures", NAMES, snap_bytes=65535, flows=flows)
    packets = [("file", 0, "alpha", "bravo"), ("ask", 4, "alpha", "bravo"), ("ask/reply", 4, "bravo", "alpha")]
    packets.append(("again", 0, "alpha", "bravo"))
    for number, (flow, index, source, destination) in enumerate(packets):
        packet = IpPacket(source, destination, "udp", 84, (flow, index), number)
        captures.log(number * MS, "alpha", Fragment(packet, number, 0, 1, 0, 84))
    captures.flush()
    captures.close()
    content = (tmp_path / "captures" / "alpha.pcap").read_bytes()
    (tmp_path / "part.pcap").write_bytes(packets_between(content, MS, 3 * MS))
    frames = list(PcapReader(str(tmp_path / "captures" / "alpha.pcap")))
    assert frames[0][UDP].dport == 1234
    request, reply, other = (frame[ICMP] for frame in frames[1:])
    assert [(echo.type, echo.seq) for echo in (request, reply, other)] == [(8, 5), (0, 5), (8, 1)]
    assert request.id == reply.id != other.id
    for frame in frames[1:]:
        checksum = frame[ICMP].chksum
        frame[ICMP].chksum = None
        assert IP(bytes(frame))[ICMP].chksum == checksum
    assert [frame.time for frame in PcapReader(str(tmp_path / "part.pcap"))] == [frame.time for frame in frames[1:3]]
