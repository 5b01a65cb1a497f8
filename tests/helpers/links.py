"""A simulated link, the captures at both ends, and the ground truth about them; each packet has a unique number.

Nothing here uses the code under test. The headers are packed with struct, and copies are identified by the numbers.
"""

import random
import struct
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from ipaddress import ip_address

from tests.helpers.captures import PORT, RECEIVER, SENDER, Frame

SENDER_V6, RECEIVER_V6 = "fd00::1", "fd00::2"
MS = 1_000_000
SNAP_BYTES = 128
MSS = 1000


@dataclass
class Link:
    """The effect of a link on each packet.

    Attributes:
        seed: Seed of the random numbers.
        loss: Share of packets that are lost.
        copied: Share of the arriving packets that arrive again 10 us later.
        late: Share of the arriving packets that are delayed by an additional `late_ns`.
        delay_ns: Delay of a packet.
        jitter_ns: Maximum of the additional random delay.
        clock_ns: Offset of the receiver's clock.
    """

    seed: int
    loss: float = 0.0
    copied: float = 0.0
    late: float = 0.0
    late_ns: int = 7 * MS
    delay_ns: int = 3 * MS
    jitter_ns: int = 0
    clock_ns: int = 12_345_678_901
    draw: random.Random = field(init=False)

    def __post_init__(self) -> None:
        self.draw = random.Random(self.seed)

    def arrivals(self, sent_ns: Sequence[int]) -> list[tuple[int, int]]:
        """Arrival times by the receiver's clock with the index of the packet, in order of arrival."""
        arrivals = []
        for number, sent_at_ns in enumerate(sent_ns):
            if self.draw.random() < self.loss:
                continue
            arrival_ns = sent_at_ns + self.clock_ns + self.delay_ns + self.draw.randint(0, self.jitter_ns)
            arrival_ns += self.late_ns * (self.draw.random() < self.late)
            arrivals.append((arrival_ns, number))
            if self.draw.random() < self.copied:
                arrivals.append((arrival_ns + 10_000, number))
        return sorted(arrivals)


@dataclass(frozen=True)
class PacketFates:
    """The fates of the sent packets.

    Attributes:
        lost: Number of packets that never arrived.
        duplicated: Number of arrivals beyond the first of each packet.
        reordered: Number of packets that first arrive after a packet that was sent later.
        bursts: Number of runs of lost packets.
    """

    lost: int
    duplicated: int
    reordered: int
    bursts: int

    @classmethod
    def of(cls, sent: int, arrived: Sequence[int]) -> "PacketFates":
        arrived_once = set(arrived)
        latest, reordered = -1, 0
        for number in dict.fromkeys(arrived):
            reordered += number < latest
            latest = max(latest, number)
        is_lost = [number not in arrived_once for number in range(sent)]
        bursts = sum(lost and not lost_before for lost, lost_before in zip(is_lost, [False, *is_lost], strict=False))
        return cls(sum(is_lost), len(arrived) - len(arrived_once), reordered, bursts)


def ip(
    payload: bytes, *, protocol: int, size: int, ip_id: int | None = 0, ends: tuple[str, str] | None = None
) -> bytes:
    """A packet with `size` payload bytes on the wire; an IPv6 packet if `ip_id` is None."""
    if ip_id is None:
        source, target = (ip_address(address).packed for address in ends or (SENDER_V6, RECEIVER_V6))
        # The length field of a super-frame is 0 because its length does not fit into the field.
        return struct.pack(">IHBB", 6 << 28, size if size < 65_536 else 0, protocol, 64) + source + target + payload
    source, target = (ip_address(address).packed for address in ends or (SENDER, RECEIVER))
    total = size + 20 if size + 20 < 65_536 else 0
    return struct.pack(">BBHHHBBH", 0x45, 0, total, ip_id, 0x4000, 64, protocol, 0) + source + target + payload


def udp(content: bytes, *, ip_id: int | None, sport: int = 40_000, ends: tuple[str, str] | None = None) -> bytes:
    """An unfragmented datagram, truncated as in a capture."""
    udp_header = struct.pack(">HHHH", sport, PORT, 8 + len(content), 0)
    return ip(udp_header + content, protocol=17, size=8 + len(content), ip_id=ip_id, ends=ends)[:SNAP_BYTES]


@dataclass(frozen=True)
class Segment:
    """A TCP segment on the wire: the start of its payload, its size, its timestamp and its IP id."""

    start: int
    size: int
    stamp: int | None
    ip_id: int | None


@dataclass(frozen=True)
class TcpTruth:
    """A TCP transfer: both captures, and the correct results of their analysis.

    Attributes:
        sender: Frames of the sender's capture.
        receiver: Frames of the receiver's capture.
        sent_bytes: Payload of all sent segments, retransmissions included.
        received_bytes: Payload of the sent segments that arrived, retransmissions included.
        retransmitted: Number of sent frames whose first segment had been sent before.
        spurious: Number of sent frames whose segments had all arrived in earlier copies.
        reordered: Number of received frames whose first segment arrived after a segment that was sent later.
        duplicated_bytes: Payload of arrivals beyond the first of each segment.
    """

    sender: list[Frame]
    receiver: list[Frame]
    sent_bytes: int
    received_bytes: int
    retransmitted: int
    spurious: int
    reordered: int
    duplicated_bytes: int


def tcp(
    link: Link,
    segments: int,
    *,
    ids: bool,
    ipv6: bool = False,
    stamped: bool = True,
    offload: int = 1,
    again: float = 0.0,
    ends: tuple[str, str] | None = None,
    sport: int = 40_000,
) -> TcpTruth:
    """A TCP transfer; lost segments are sent again after 30 ms, and a share `again` of the others is sent needlessly.

    A frame in the sender's capture has up to `offload` segments; in the receiver's capture, contiguous segments are
    coalesced in the same way.
    """
    frames: list[list[Segment]] = []
    times_ns: list[int] = []
    clock = 10**18
    counter = iter(range(7, 10**9))
    isn = 2**32 - 5 * MSS - 1  # so that sequence numbers wrap
    ticks = 2**32 - 20  # so that timestamps wrap

    def send(first: int, count: int, at_ns: int) -> None:
        stamp = (ticks + (at_ns - clock) // MS) % 2**32 if stamped else None
        ip_ids = [None if ipv6 else next(counter) % 65_536 if ids else 0 for _ in range(count)]
        frames.append([Segment((first + index) * MSS, MSS, stamp, ip_id) for index, ip_id in enumerate(ip_ids)])
        times_ns.append(at_ns)

    at_ns, first = clock + MS, 0
    while first < segments:
        count = min(link.draw.randint(1, offload), segments - first)
        send(first, count, at_ns)
        first, at_ns = first + count, at_ns + 2 * MS
    arrivals = _transmit(link, frames, times_ns, 0)
    arrived_starts = {segment.start for _, _, segment in arrivals}
    missing = [start for start in range(0, segments * MSS, MSS) if start not in arrived_starts]
    unneeded = [start for start in sorted(arrived_starts) if link.draw.random() < again]
    again_ns = at_ns + 30 * MS
    while missing or unneeded:
        first_frame = len(frames)
        for start in sorted(missing + unneeded):
            send(start // MSS, 1, again_ns)
            again_ns += 2 * MS
        new_arrivals = _transmit(link, frames[first_frame:], times_ns[first_frame:], first_frame)
        arrivals, unneeded = arrivals + new_arrivals, []
        missing = sorted(set(missing) - {segment.start for _, _, segment in new_arrivals})
        again_ns += 30 * MS
    arrivals.sort(key=lambda arrival: arrival[0])

    def packet(start: int, size: int, stamp: int | None, ip_id: int | None, flags: int = 0x10) -> bytes:
        options = b"" if stamp is None else struct.pack(">BBBBII", 1, 1, 8, 10, stamp, 1)
        header_words = 5 + len(options) // 4
        seq = (isn + 1 + start) % 2**32
        tcp_header = struct.pack(">HHIIBBHHH", sport, PORT, seq, 77, header_words << 4, flags, 502, 0, 0) + options
        payload = bytes((start + index) % 251 for index in range(min(size, 64)))
        return ip(tcp_header + payload, protocol=6, size=len(tcp_header) + size, ip_id=ip_id, ends=ends)

    def frame(at_ns: int, group: Sequence[Segment]) -> Frame:
        data = packet(group[0].start, sum(segment.size for segment in group), group[0].stamp, group[0].ip_id)
        return Frame(at_ns, data[:SNAP_BYTES], 40 + 60 + MSS * len(group))

    syn = packet(-1, 0, ticks if stamped else None, None if ipv6 else 1, flags=0x02)
    joined = list(_coalesce(arrivals, offload))
    order = [number for _, number, _ in arrivals]
    position = {(number, segment.start): index for index, (number, segment) in enumerate(
        (number, segment) for number, group in enumerate(frames) for segment in group)}  # fmt: skip
    arrived = {(number, segment.start) for _, number, segment in arrivals}
    sent = [segment for group in frames for segment in group]
    return TcpTruth(
        sender=[Frame(clock, syn), *(frame(at_ns, group) for at_ns, group in zip(times_ns, frames, strict=True))],
        receiver=[
            Frame(clock + link.clock_ns + link.delay_ns, syn),
            *(frame(at_ns, [segment for _, segment in group]) for at_ns, group in joined),
        ],
        sent_bytes=len(sent) * MSS,
        received_bytes=len(arrived) * MSS,
        retransmitted=sum(
            frames[number][0].start in _segment_starts(frames[:number]) for number in range(len(frames))
        ),
        spurious=sum(
            all(any((earlier, segment.start) in arrived for earlier in range(number)) for segment in group)
            for number, group in enumerate(frames)
        ),
        reordered=_reordered(joined, position),
        duplicated_bytes=(len(order) - len({segment.start for _, _, segment in arrivals})) * MSS,
    )


def _transmit(
    link: Link, frames: Sequence[Sequence[Segment]], times_ns: Sequence[int], first_frame: int
) -> list[tuple[int, int, Segment]]:
    transmitted = [
        (at_ns + number, first_frame + frame_index, segment)
        for frame_index, (at_ns, frame) in enumerate(zip(times_ns, frames, strict=True))
        for number, segment in enumerate(frame)
    ]
    return [
        (at, transmitted[index][1], transmitted[index][2])
        for at, index in link.arrivals([at for at, _, _ in transmitted])
    ]


def _coalesce(
    arrivals: Sequence[tuple[int, int, Segment]], limit: int
) -> Iterator[tuple[int, list[tuple[int, Segment]]]]:
    """Coalesce contiguous segments that arrive within 100 us with the same timestamp, as GRO does."""
    at_ns, group = 0, list[tuple[int, Segment]]()
    for arrival_ns, number, segment in arrivals:
        last = group[-1][1] if group else None
        is_contiguous = last is not None and last.start + last.size == segment.start and last.stamp == segment.stamp
        if not (is_contiguous and len(group) < limit and arrival_ns - at_ns < 100_000):
            if group:
                yield at_ns, group
            at_ns, group = arrival_ns, []
        group.append((number, segment))
    if group:
        yield at_ns, group


def _segment_starts(frames: Sequence[Sequence[Segment]]) -> set[int]:
    return {segment.start for group in frames for segment in group}


def _reordered(joined: Sequence[tuple[int, list[tuple[int, Segment]]]], position: dict[tuple[int, int], int]) -> int:
    arrived_packets, latest, reordered = set[int](), -1, 0
    for _, group in joined:
        for index, (number, segment) in enumerate(group):
            order = position[number, segment.start]
            reordered += index == 0 and order not in arrived_packets and order < latest
            if order not in arrived_packets:
                latest = max(latest, order)
            arrived_packets.add(order)
    return reordered
