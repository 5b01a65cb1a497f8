"""Captures of both ends of one stream, built by scapy, whose deliveries the test decides."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from scapy.layers.inet import IP, TCP, UDP, fragment
from scapy.packet import Raw

from fieldkit.measure.captures.packets import Packets
from tests.helpers.captures import PORT, RECEIVER, SENDER, Frame, packets

SECOND = 1_000_000_000
MS = 1_000_000
START = 1_700_000_000 * SECOND
ISN = 2**32 - 1500
"""So that sequence numbers wrap."""
SEGMENT_BYTES = 1000


@dataclass
class Stream:
    """Frames in both captures; times are nanoseconds from the beginning, by one clock, arrivals a delay later."""

    delay_ns: int = 2 * MS
    sport: int = 40000
    port: int = PORT
    source: str = SENDER
    destination: str = RECEIVER
    ahead_ns: int = 0
    sender: list[Frame] = field(default_factory=list)
    receiver: list[Frame] = field(default_factory=list)

    def _add(self, packet: IP, at_ns: int, *, arrives: bool, back: bool = False) -> None:
        data = bytes(packet)
        near, far = START + at_ns, START + at_ns + self.ahead_ns
        if back:
            self.receiver.append(Frame(far, data))
            self.sender.append(Frame(near + self.delay_ns, data))
            return
        self.sender.append(Frame(near, data))
        if arrives:
            self.receiver.append(Frame(far + self.delay_ns, data))

    def forward(self, at_ns: int, seq: int, flags: str, payload: bytes = b"", *, arrives: bool = True) -> None:
        """A TCP frame of the sender."""
        head = TCP(
            sport=self.sport, dport=self.port, seq=seq % 2**32, flags=flags, options=[("Timestamp", (at_ns // MS, 0))]
        )
        # Each packet sent has an IP id of its own, as Linux gives it.
        own = IP(src=self.source, dst=self.destination, id=1 + len(self.sender) % 65535)
        self._add(own / head / Raw(payload), at_ns, arrives=arrives)

    def opens(self, at_ns: int = 0, *, lost: Sequence[int] = ()) -> None:
        """A handshake, its SYN lost at these times before."""
        for lost_ns in lost:
            self.forward(lost_ns, ISN, "S", arrives=False)
        self.forward(at_ns, ISN, "S")
        answer = TCP(sport=self.port, dport=self.sport, seq=7, ack=(ISN + 1) % 2**32, flags="SA")
        self._add(IP(src=self.destination, dst=self.source) / answer, at_ns + self.delay_ns, arrives=True, back=True)

    def segment(self, number: int, at_ns: int, *, arrives: bool = True, segments: int = 1) -> None:
        """Some segments in one frame, as offload makes them, from this one on."""
        seq = ISN + 1 + number * SEGMENT_BYTES
        self.forward(at_ns, seq, "A", bytes([number % 251]) * SEGMENT_BYTES * segments, arrives=arrives)

    def answer(self, number: int, at_ns: int) -> None:
        """The receiver acknowledges all before a segment."""
        ack = TCP(sport=self.port, dport=self.sport, seq=8, ack=(ISN + 1 + number * SEGMENT_BYTES) % 2**32, flags="A")
        self._add(IP(src=self.destination, dst=self.source, id=number + 1) / ack, at_ns, arrives=True, back=True)

    def datagram(self, number: int, at_ns: int, *, size: int = 1000, arrives: bool = True, mtu: int = 1500) -> None:
        """A datagram, in fragments where it is larger than a frame; of one that is lost the last fragment."""
        payload = number.to_bytes(8, "big") * (size // 8)
        own = IP(src=self.source, dst=self.destination, id=1 + number % 65535)
        whole = own / UDP(sport=self.sport, dport=self.port) / Raw(payload)
        pieces = fragment(whole, mtu - 20) if len(whole) > mtu else [whole]  # type: ignore[no-untyped-call]
        for index, piece in enumerate(pieces):
            self._add(piece, at_ns + index * 1000, arrives=arrives or index < len(pieces) - 1)


def captured(streams: Iterable[Stream]) -> tuple[Packets, Packets]:
    """Return the packets of both captures, in the order of time."""
    together = list(streams)
    near, far = ([frame for stream in together for frame in getattr(stream, end)] for end in ("sender", "receiver"))
    return tuple(packets(sorted(frames, key=lambda frame: frame.time_ns)) for frames in (near, far))  # type: ignore[return-value]
