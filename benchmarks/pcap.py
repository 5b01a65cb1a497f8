"""Compute losses and times of a transfer from two captures, compared with other readers: `python -m benchmarks.pcap`.

The captures are of a UDP transfer of 200,000 IP packets with a loss of 10 %: fragments of 8,192-byte datagrams, with
128 bytes captured of each, as in a trial. Each peer reads both captures, and matches the packets by identification
and offset. In every round all peers run one after the other, and all must compute the same losses.
fieldkit computes all values that `fieldkit.measure.transfers.transfer_measures` computes from captures: losses of
packets, datagrams and bytes, the transfer's time, and the counts of the paper (docs/index.md). The other readers,
dpkt, tshark and scapy, only count lost packets. scapy would take minutes, so it reads only the first packets; tshark
is omitted if it is not installed. Times are processor times, including child processes, because other load affects
processor time less than wall time.

At the end fieldkit streams a sparse file of 10 GB in a separate process, whose peak memory is printed. With `--whole
MIB` another process reads a capture of this size into columns, as a trial does.
"""

import argparse
import json
import os
import random
import resource
import shutil
import statistics
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from itertools import islice
from pathlib import Path
from typing import Final

import dpkt
from scapy.layers.inet import IP, UDP
from scapy.utils import PcapReader

from fieldkit.core.model import Protocol, Role
from fieldkit.measure.captures import pcap
from fieldkit.measure.transfers import transfer_measures, udp
from fieldkit.measure.transfers.transfer_spec import Transfer

PACKETS: Final = 200_000
SCAPY_PACKETS: Final = 4_000
LOSS: Final = 0.1
BIG_BYTES: Final = 10_000_000_000
TRANSFER: Final = Transfer(
    Protocol.UDP, Role.SENDER, Role.RECEIVER, "10.0.0.1", "10.0.0.2", 1234, "scan.bag", "recv.bag"
)
FILE_HEADER: Final = struct.pack("<IHHiIII", 0xA1B23C4D, 2, 4, 0, 0, 262_144, 1)

STREAM: Final = """
import json, pathlib, re, sys
from fieldkit.measure.captures import pcap
def peak_kb():
    return int(re.search(r"VmHWM:\\s+(\\d+)", pathlib.Path("/proc/self/status").read_text())[1])
before = peak_kb()
print(json.dumps([sum(len(part.packets) for part in pcap.stream(pathlib.Path(sys.argv[1]))), before, peak_kb()]))
"""
"""Prints the number of packets of a file, and the peak memory of its process in KiB before and after reading them."""

READ: Final = STREAM.replace("sum(len(part.packets) for part in pcap.stream(", "len(pcap.read(").replace(
    "sys.argv[1])))", "sys.argv[1])).packets)"
)
"""The same program, but it keeps all packets in columns."""

Peer = Callable[[Path, Path], int]
"""Returns the number of lost packets from the captures of sender and receiver."""
Key = tuple[int, int]
"""Identification and offset of an IP packet."""


def fragments() -> Iterator[bytes]:
    """Yield frames with fragments of 8,192-byte datagrams: headers, and the first bytes of the payload."""
    for ip_id in range(PACKETS // 6 + 1):
        for offset, size in ((0, 1480), (1480, 1480), (2960, 1480), (4440, 1480), (5920, 1480), (7400, 800)):
            part = offset // 8 | (0x2000 if size == 1480 else 0)
            header = struct.pack(">BBHHHBBH", 0x45, 0, 20 + size, ip_id & 0xFFFF, part, 64, 17, 0)
            udp_header = struct.pack(">HHHH", 40000, 1234, 8200, 0) if offset == 0 else bytes(8)
            addresses = bytes((10, 0, 0, 1, 10, 0, 0, 2))
            yield bytes(12) + b"\x08\x00" + header + addresses + udp_header + bytes(86)


def record(index: int, frame: bytes, wire_bytes: int) -> bytes:
    """Return a frame with its record header; frames are 0.1 ms apart."""
    seconds, nanoseconds = divmod(index * 100_000, 1_000_000_000)
    return struct.pack("<4I", 1_700_000_000 + seconds, nanoseconds, len(frame), wire_bytes) + frame


def write_captures(folder: Path) -> tuple[Path, Path]:
    """Write the captures of sender and receiver."""
    generator = random.Random(1)
    sent = [record(index, frame, 1514) for index, frame in enumerate(islice(fragments(), PACKETS))]
    received = [frame for frame in sent if generator.random() >= LOSS]
    paths = folder / "sender.pcap", folder / "receiver.pcap"
    for path, records in zip(paths, (sent, received), strict=True):
        path.write_bytes(FILE_HEADER + b"".join(records))
    return paths


def losses_by_fieldkit(sender: Path, receiver: Path) -> int:
    """Return the number of lost packets."""
    sent, received = pcap.read(sender).packets, pcap.read(receiver).packets
    transfer_measures.paper_frames_from(sent, TRANSFER.sender_address, TRANSFER.port)
    transfer_measures.paper_frames_to(received, TRANSFER.receiver_address, TRANSFER.port)
    counts = udp.count(udp.match_transfer(sent, received, TRANSFER))
    return counts.packets_sent - counts.packets_received


def lost_count(sent: Iterable[Key], received: Iterable[Key]) -> int:
    """Return the number of sent packets that did not arrive; packets with the same key are counted individually."""
    return (Counter(sent) - Counter(received)).total()


def losses_by_dpkt(sender: Path, receiver: Path) -> int:
    """Return the number of lost packets."""
    return lost_count(*(list(_keys_by_dpkt(path)) for path in (sender, receiver)))


def _keys_by_dpkt(path: Path) -> Iterator[Key]:
    with path.open("rb") as file:
        for _, data in dpkt.pcap.Reader(file):
            ip = dpkt.ethernet.Ethernet(data).data
            yield ip.id, ip.offset


def losses_by_tshark(sender: Path, receiver: Path) -> int:
    """Return the number of lost packets."""
    return lost_count(*(list(_keys_by_tshark(path)) for path in (sender, receiver)))


def _keys_by_tshark(path: Path) -> Iterator[Key]:
    names = (
        "frame.time_epoch",
        "ip.src",
        "ip.dst",
        "ip.id",
        "ip.frag_offset",
        "udp.srcport",
        "udp.dstport",
        "ip.len",
    )
    argv = ["tshark", "-n", "-o", "ip.defragment:FALSE", "-r", str(path), "-T", "fields"]
    argv += [word for name in names for word in ("-e", name)]
    printed = subprocess.run(argv, capture_output=True, text=True, check=True).stdout
    for line in printed.splitlines():
        columns = line.split("\t")
        yield int(columns[3], 16), int(columns[4])


def losses_by_scapy(sender: Path, receiver: Path) -> int:
    """Return the number of lost packets among the first ones."""
    sent = list(_keys_by_scapy(sender))
    return lost_count(sent, _keys_by_scapy(receiver))


def _keys_by_scapy(path: Path) -> Iterator[Key]:
    with PcapReader(str(path)) as reader:
        for frame in reader:
            ip = frame[IP]
            _ = frame.time, ip.src, ip.dst, ip.len, frame[UDP].dport if UDP in frame else None
            yield ip.id, ip.frag


def first_packets(source: Path, count: int) -> Path:
    """Write a file with the first packets of another capture; return its path."""
    record_bytes = 16 + len(next(fragments()))
    path = source.with_name(f"first-{source.name}")
    path.write_bytes(source.read_bytes()[: len(FILE_HEADER) + count * record_bytes])
    return path


def write_big(path: Path) -> int:
    """Write a sparse capture of 10 GB with frames of 256 KiB (segmentation offload); return its number of packets."""
    header = bytes(12) + b"\x08\x00" + struct.pack(">BBHHHBBH", 0x45, 0, 0, 1, 0, 64, 6, 0) + bytes((10, 0, 0, 1) * 2)
    captured_bytes = 262_144
    count = BIG_BYTES // (16 + captured_bytes)
    with path.open("wb") as file:
        file.write(FILE_HEADER)
        for index in range(count):
            start = len(FILE_HEADER) + index * (16 + captured_bytes)
            file.seek(start)
            file.write(struct.pack("<4I", 1_700_000_000 + index, 0, captured_bytes, captured_bytes) + header)
        file.truncate(len(FILE_HEADER) + count * (16 + captured_bytes))
    return count


def big_file(folder: Path) -> dict[str, float]:
    """Return the cost of streaming a file of 10 GB."""
    path = folder / "big.pcap"
    expected = write_big(path)
    start = time.perf_counter()
    argv = [sys.executable, "-c", STREAM, str(path)]
    count, before, peak = json.loads(subprocess.run(argv, capture_output=True, text=True, check=True).stdout)
    if count != expected:
        raise RuntimeError(f"{path} has {expected} packets, {count} were read")
    elapsed_s = time.perf_counter() - start
    size = path.stat().st_size
    path.unlink()
    return {"file_gb": size / 1e9, "seconds": elapsed_s, "rss_before_mb": before / 1e3, "peak_rss_mb": peak / 1e3}


def whole_file(folder: Path, mib: int) -> dict[str, float]:
    """Return the cost of reading a capture of `mib` MiB into columns."""
    path = folder / "whole.pcap"
    part, written = list(islice(fragments(), 60_000)), 0
    with path.open("wb") as file:
        file.write(FILE_HEADER)
        while file.tell() < mib << 20:
            file.writelines(record(written + index, frame, 1514) for index, frame in enumerate(part))
            written += len(part)
    argv = [sys.executable, "-c", READ, str(path)]
    count, before, peak = json.loads(subprocess.run(argv, capture_output=True, text=True, check=True).stdout)
    if count != written:
        raise RuntimeError(f"{path} has {written} packets, {count} were read")
    size = path.stat().st_size
    path.unlink()
    return {
        "whole_mib": size / 2**20,
        "packets": count,
        "rss_before_mib": before / 2**10,
        "peak_rss_mib": peak / 2**10,
    }


def processor_s() -> float:
    """Return the processor time of this process and its terminated children, in s."""
    return sum(
        usage.ru_utime + usage.ru_stime
        for usage in (resource.getrusage(scope) for scope in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


def rates(folder: Path, rounds: int) -> dict[str, list[float]]:
    """Return packets per second of processor time by peer and round."""
    all_captures = write_captures(folder)
    first_captures = (
        first_packets(all_captures[0], SCAPY_PACKETS),
        first_packets(all_captures[1], int(SCAPY_PACKETS * (1 - LOSS))),
    )
    peers: dict[str, tuple[Peer, tuple[Path, Path]]] = {
        "fieldkit": (losses_by_fieldkit, all_captures),
        "dpkt": (losses_by_dpkt, all_captures),
    }
    if shutil.which("tshark"):
        peers["tshark"] = (losses_by_tshark, all_captures)
    peers["scapy"] = (losses_by_scapy, first_captures)
    packets = {
        captures: sum(pcap.read(path).frames for path in captures) for captures in (all_captures, first_captures)
    }
    expected = {captures: losses_by_fieldkit(*captures) for captures in (all_captures, first_captures)}
    rates_by_peer: dict[str, list[float]] = {name: [] for name in peers}
    for _ in range(rounds):
        for name, (peer, captures) in peers.items():
            start = processor_s()
            losses = peer(*captures)
            rates_by_peer[name].append(packets[captures] / (processor_s() - start))
            if losses != expected[captures]:
                raise RuntimeError(f"{name} counted {losses} lost packets, fieldkit {expected[captures]}")
    return rates_by_peer


def main() -> None:
    """Run the rounds and print a table, or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--whole", type=int, default=0, metavar="MIB")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    load = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as name:
        rates_by_peer = rates(Path(name), arguments.rounds)
        big = big_file(Path(name))
        if arguments.whole:
            big |= whole_file(Path(name), arguments.whole)
    if arguments.json:
        print(json.dumps({"load": load, "packets_s": rates_by_peer, "big": big}))
        return
    print(f"load average before: {load:.2f} on {os.cpu_count()} cores\n")
    print("| | packets/s, median (lowest to highest) | fieldkit's speed / reader's speed |\n| --- | --- | --- |")
    for peer, values in rates_by_peer.items():
        ratios = [
            fieldkit_rate / peer_rate
            for fieldkit_rate, peer_rate in zip(rates_by_peer["fieldkit"], values, strict=True)
        ]
        spread = f"{statistics.median(values):,.0f} ({min(values):,.0f} to {max(values):,.0f})"
        print(f"| {peer} | {spread} | {statistics.median(ratios):,.1f} |")
    print("\n" + ", ".join(f"{key} {value:,.1f}" for key, value in big.items()))


if __name__ == "__main__":
    main()
