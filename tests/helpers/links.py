"""A link of known truth: what was sent over it, and what both ends captured; every packet has a number of its own.

Nothing here uses the code under test. Headers are written by struct; who is whose copy is known from the numbers.
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
    """What a link does to each packet.

    Attributes:
        seed: Of its draws.
        loss: Share of packets lost.
        copied: Share of those that arrive that do so twice, the second time 10 us later.
        late: Share of those that arrive that do so `late_ns` after the others.
        delay_ns: How long the others take.
        jitter_ns: And by how much more at most.
        clock_ns: By how much the receiver's clock is ahead.
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
        """Return when, by the receiver's clock, and which packet arrived, in this order."""
        found = []
        for number, at_ns in enumerate(sent_ns):
            if self.draw.random() < self.loss:
                continue
            came_ns = at_ns + self.clock_ns + self.delay_ns + self.draw.randint(0, self.jitter_ns)
            came_ns += self.late_ns * (self.draw.random() < self.late)
            found.append((came_ns, number))
            if self.draw.random() < self.copied:
                found.append((came_ns + 10_000, number))
        return sorted(found)


@dataclass(frozen=True)
class Fate:
    """What became of packets sent, by who sent them.

    Attributes:
        lost: How many never arrived.
        duplicated: How many came beyond the first of each.
        reordered: How many arrived first after one that was sent later.
        bursts: How many runs of lost ones there are.
    """

    lost: int
    duplicated: int
    reordered: int
    bursts: int

    @classmethod
    def of(cls, sent: int, arrived: Sequence[int]) -> "Fate":
        there = set(arrived)
        latest, reordered = -1, 0
        for number in dict.fromkeys(arrived):
            reordered += number < latest
            latest = max(latest, number)
        gone = [number not in there for number in range(sent)]
        bursts = sum(now and not before for now, before in zip(gone, [False, *gone], strict=False))
        return cls(sum(gone), len(arrived) - len(there), reordered, bursts)


def ip(
    payload: bytes, *, protocol: int, size: int, ip_id: int | None = 0, ends: tuple[str, str] | None = None
) -> bytes:
    """A packet of which `size` bytes of payload are on the wire; of IPv6 where `ip_id` is None."""
    if ip_id is None:
        source, target = (ip_address(one).packed for one in ends or (SENDER_V6, RECEIVER_V6))
        # A super-frame has no room for its length, which is then 0.
        return struct.pack(">IHBB", 6 << 28, size if size < 65_536 else 0, protocol, 64) + source + target + payload
    source, target = (ip_address(one).packed for one in ends or (SENDER, RECEIVER))
    total = size + 20 if size + 20 < 65_536 else 0
    return struct.pack(">BBHHHBBH", 0x45, 0, total, ip_id, 0x4000, 64, protocol, 0) + source + target + payload


def udp(content: bytes, *, ip_id: int | None, sport: int = 40_000, ends: tuple[str, str] | None = None) -> bytes:
    """An unfragmented datagram, cut as a capture cuts it."""
    head = struct.pack(">HHHH", sport, PORT, 8 + len(content), 0)
    return ip(head + content, protocol=17, size=8 + len(content), ip_id=ip_id, ends=ends)[:SNAP_BYTES]


@dataclass(frozen=True)
class Segment:
    """A TCP segment as the wire carries it: where its payload begins, its bytes, its time stamp and IP id."""

    start: int
    size: int
    stamp: int | None
    ip_id: int | None


@dataclass(frozen=True)
class TcpTruth:
    """A transfer by TCP: both captures, and what they must be found to say."""

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
    """Return a transfer: what is lost is sent again after 30 ms, and a share of all others, `again`, needlessly.

    The sender's capture holds up to `offload` segments in a frame, the receiver's too where they follow each other.
    """
    frames: list[list[Segment]] = []
    times_ns: list[int] = []
    clock = 10**18
    counter = iter(range(7, 10**9))
    isn = 2**32 - 5 * MSS - 1  # wraps
    ticks = 2**32 - 20  # so do the time stamps

    def send(first: int, count: int, at_ns: int) -> None:
        stamp = (ticks + (at_ns - clock) // MS) % 2**32 if stamped else None
        names = [None if ipv6 else next(counter) % 65_536 if ids else 0 for _ in range(count)]
        frames.append([Segment((first + at) * MSS, MSS, stamp, name) for at, name in enumerate(names)])
        times_ns.append(at_ns)

    at_ns, first = clock + MS, 0
    while first < segments:
        count = min(link.draw.randint(1, offload), segments - first)
        send(first, count, at_ns)
        first, at_ns = first + count, at_ns + 2 * MS
    came = _carried(link, frames, times_ns, 0)
    there = {segment.start for _, _, segment in came}
    missing = [start for start in range(0, segments * MSS, MSS) if start not in there]
    needless = [start for start in sorted(there) if link.draw.random() < again]
    again_ns = at_ns + 30 * MS
    while missing or needless:
        begin = len(frames)
        for start in sorted(missing + needless):
            send(start // MSS, 1, again_ns)
            again_ns += 2 * MS
        more = _carried(link, frames[begin:], times_ns[begin:], begin)
        came, needless = came + more, []
        missing = sorted(set(missing) - {segment.start for _, _, segment in more})
        again_ns += 30 * MS
    came.sort(key=lambda one: one[0])

    def packet(start: int, size: int, stamp: int | None, ip_id: int | None, flags: int = 0x10) -> bytes:
        options = b"" if stamp is None else struct.pack(">BBBBII", 1, 1, 8, 10, stamp, 1)
        words = 5 + len(options) // 4
        seq = (isn + 1 + start) % 2**32
        head = struct.pack(">HHIIBBHHH", sport, PORT, seq, 77, words << 4, flags, 502, 0, 0) + options
        kept = bytes((start + at) % 251 for at in range(min(size, 64)))
        return ip(head + kept, protocol=6, size=len(head) + size, ip_id=ip_id, ends=ends)

    def frame(at_ns: int, these: Sequence[Segment]) -> Frame:
        whole = packet(these[0].start, sum(one.size for one in these), these[0].stamp, these[0].ip_id)
        return Frame(at_ns, whole[:SNAP_BYTES], 40 + 60 + MSS * len(these))

    syn = packet(-1, 0, ticks if stamped else None, None if ipv6 else 1, flags=0x02)
    joined = list(_joined(came, offload))
    order = [number for _, number, _ in came]
    place = {(number, one.start): at for at, (number, one) in enumerate(
        (number, one) for number, these in enumerate(frames) for one in these)}  # fmt: skip
    arrived = {(number, one.start) for _, number, one in came}
    sent = [one for these in frames for one in these]
    return TcpTruth(
        sender=[Frame(clock, syn), *(frame(at, these) for at, these in zip(times_ns, frames, strict=True))],
        receiver=[
            Frame(clock + link.clock_ns + link.delay_ns, syn),
            *(frame(at, [one for _, one in these]) for at, these in joined),
        ],
        sent_bytes=len(sent) * MSS,
        received_bytes=len(arrived) * MSS,
        retransmitted=sum(frames[number][0].start in _starts(frames[:number]) for number in range(len(frames))),
        spurious=sum(
            all(any((before, one.start) in arrived for before in range(number)) for one in these)
            for number, these in enumerate(frames)
        ),
        reordered=_late(joined, place),
        duplicated_bytes=(len(order) - len({one.start for _, _, one in came})) * MSS,
    )


def _carried(
    link: Link, frames: Sequence[Sequence[Segment]], times_ns: Sequence[int], begin: int
) -> list[tuple[int, int, Segment]]:
    each = [(at + number, begin + index, one) for index, (at, these) in enumerate(zip(times_ns, frames, strict=True))
            for number, one in enumerate(these)]  # fmt: skip
    return [(at, each[which][1], each[which][2]) for at, which in link.arrivals([at for at, _, _ in each])]


def _joined(came: Sequence[tuple[int, int, Segment]], most: int) -> Iterator[tuple[int, list[tuple[int, Segment]]]]:
    """Join segments that follow each other within 100 us and have one time stamp, as GRO does."""
    at_ns, held = 0, list[tuple[int, Segment]]()
    for came_ns, number, one in came:
        last = held[-1][1] if held else None
        follows = last is not None and last.start + last.size == one.start and last.stamp == one.stamp
        if not (follows and len(held) < most and came_ns - at_ns < 100_000):
            if held:
                yield at_ns, held
            at_ns, held = came_ns, []
        held.append((number, one))
    if held:
        yield at_ns, held


def _starts(frames: Sequence[Sequence[Segment]]) -> set[int]:
    return {one.start for these in frames for one in these}


def _late(joined: Sequence[tuple[int, list[tuple[int, Segment]]]], place: dict[tuple[int, int], int]) -> int:
    seen, latest, late = set[int](), -1, 0
    for _, these in joined:
        for at, (number, one) in enumerate(these):
            which = place[number, one.start]
            late += at == 0 and which not in seen and which < latest
            if which not in seen:
                latest = max(latest, which)
            seen.add(which)
    return late
