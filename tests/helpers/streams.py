"""Captures of one stream at both robots; scapy builds the packets, and the test selects which packets arrive."""

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
"""Initial sequence number, so high that sequence numbers wrap early in the stream."""
SEGMENT_BYTES = 1000


@dataclass
class Stream:
    """Frames of both captures.

    Arguments of the methods are in ns since the start, by the sender's clock. The receiver's clock is ahead of it by
    `ahead_ns`. Packets arrive after `delay_ns`.
    """

    delay_ns: int = 2 * MS
    sport: int = 40000
    port: int = PORT
    source: str = SENDER
    destination: str = RECEIVER
    ahead_ns: int = 0
    sender: list[Frame] = field(default_factory=list)
    receiver: list[Frame] = field(default_factory=list)

    def _add(self, packet: IP, at_ns: int, *, arrives: bool, is_reply: bool = False) -> None:
        data = bytes(packet)
        sender_ns, receiver_ns = START + at_ns, START + at_ns + self.ahead_ns
        if is_reply:
            self.receiver.append(Frame(receiver_ns, data))
            self.sender.append(Frame(sender_ns + self.delay_ns, data))
            return
        self.sender.append(Frame(sender_ns, data))
        if arrives:
            self.receiver.append(Frame(receiver_ns + self.delay_ns, data))

    def forward(self, at_ns: int, seq: int, flags: str, payload: bytes = b"", *, arrives: bool = True) -> None:
        """Send a TCP segment from the sender."""
        tcp_header = TCP(
            sport=self.sport, dport=self.port, seq=seq % 2**32, flags=flags, options=[("Timestamp", (at_ns // MS, 0))]
        )
        # Linux gives each sent packet a different IP id.
        ip_header = IP(src=self.source, dst=self.destination, id=1 + len(self.sender) % 65535)
        self._add(ip_header / tcp_header / Raw(payload), at_ns, arrives=arrives)

    def handshake(self, at_ns: int = 0, *, lost: Sequence[int] = ()) -> None:
        """Perform a TCP handshake; `lost` has the earlier times at which a lost SYN was sent."""
        for lost_ns in lost:
            self.forward(lost_ns, ISN, "S", arrives=False)
        self.forward(at_ns, ISN, "S")
        syn_ack = TCP(sport=self.port, dport=self.sport, seq=7, ack=(ISN + 1) % 2**32, flags="SA")
        self._add(
            IP(src=self.destination, dst=self.source) / syn_ack, at_ns + self.delay_ns, arrives=True, is_reply=True
        )

    def segment(self, number: int, at_ns: int, *, arrives: bool = True, segments: int = 1) -> None:
        """Send consecutive segments in one frame, as segmentation offload does; `number` is the first segment."""
        seq = ISN + 1 + number * SEGMENT_BYTES
        self.forward(at_ns, seq, "A", bytes([number % 251]) * SEGMENT_BYTES * segments, arrives=arrives)

    def answer(self, number: int, at_ns: int) -> None:
        """Acknowledge all segments before `number`."""
        ack = TCP(sport=self.port, dport=self.sport, seq=8, ack=(ISN + 1 + number * SEGMENT_BYTES) % 2**32, flags="A")
        self._add(IP(src=self.destination, dst=self.source, id=number + 1) / ack, at_ns, arrives=True, is_reply=True)

    def datagram(self, number: int, at_ns: int, *, size: int = 1000, arrives: bool = True, mtu: int = 1500) -> None:
        """Send a datagram, in fragments if it exceeds the MTU; if it is lost, only its last fragment is lost."""
        payload = number.to_bytes(8, "big") * (size // 8)
        ip_header = IP(src=self.source, dst=self.destination, id=1 + number % 65535)
        packet = ip_header / UDP(sport=self.sport, dport=self.port) / Raw(payload)
        fragments = fragment(packet, mtu - 20) if len(packet) > mtu else [packet]  # type: ignore[no-untyped-call]
        for index, fragment_packet in enumerate(fragments):
            self._add(fragment_packet, at_ns + index * 1000, arrives=arrives or index < len(fragments) - 1)


def captured(streams: Iterable[Stream]) -> tuple[Packets, Packets]:
    """Packets of both captures, in order of time."""
    all_streams = list(streams)
    sender_frames, receiver_frames = (
        [frame for stream in all_streams for frame in getattr(stream, end)] for end in ("sender", "receiver")
    )
    return tuple(
        packets(sorted(frames, key=lambda frame: frame.time_ns)) for frames in (sender_frames, receiver_frames)
    )  # type: ignore[return-value]
