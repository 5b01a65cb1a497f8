"""A connection: its two ends, the messages that go through it, and the packets that its segments travel in."""

from collections.abc import Callable
from dataclasses import dataclass

from sim_backends.network.packets import Packet
from sim_backends.network.tcp.messages import MessageStream
from sim_backends.network.tcp.options import TcpOptions
from sim_backends.network.tcp.receiver import Receiver
from sim_backends.network.tcp.segments import Segment
from sim_backends.network.tcp.sender import Sender
from sim_backends.network.wire import IpPacket, Wire


@dataclass(frozen=True, slots=True)
class ConnectionName:
    """Names a connection; stands for addresses and ports.

    Attributes:
        source: Who sends.
        destination: To whom.
        flow: Which flow.
        number: Which connection of that flow, from 0.
    """

    source: str
    destination: str
    flow: str
    number: int


@dataclass(frozen=True, slots=True)
class TcpSample:
    """The state of a sender after something happened to it.

    Attributes:
        at_ns: When.
        connection: Whose.
        event: What happened: `ack`, `loss`, `timeout`, `idle`.
        window_bytes: Congestion window.
        threshold_bytes: Slow-start threshold; None while it is as high as can be.
        flight_bytes: What is taken to be under way.
        round_trip_ns: Smoothed round trip.
        timeout_ns: Retransmission timeout.
    """

    at_ns: int
    connection: ConnectionName
    event: str
    window_bytes: int
    threshold_bytes: int | None
    flight_bytes: int
    round_trip_ns: int | None
    timeout_ns: int


TcpLog = Callable[[TcpSample], None]


class TcpConnection:
    """One connection, open or being opened, and used in one direction.

    What goes back on the same connection is another one here, which is open from the beginning. Its ACKs and the data
    of the first travel in packets of their own.

    Args:
        wire: What it stands on.
        options: Of TCP.
        name: Its name.
        closed: Told when it was given up and its messages were dropped.
        log: Handed the state of the sender after everything that happened to it; None for nobody.
        round_trip_ns: If it is open already, the round trip that its handshake told; None opens it.
    """

    def __init__(
        self,
        wire: Wire,
        options: TcpOptions,
        name: ConnectionName,
        *,
        closed: Callable[[ConnectionName], None],
        log: TcpLog | None,
        round_trip_ns: int | None = None,
    ) -> None:
        self._wire = wire
        self._name = name
        self._closed = closed
        self._log = log
        self._stream = MessageStream(options.segment_bytes)
        self._receiver = Receiver(
            wire,
            name.destination,
            options,
            transmit=self._to_source,
            read=self._read,
            opened=round_trip_ns is not None,
        )
        self._sender = Sender(
            wire,
            name.source,
            options,
            self._stream,
            transmit=self._to_destination,
            give_up=self._give_up,
            log=self._note,
            round_trip_ns=round_trip_ns,
        )

    @property
    def round_trip_ns(self) -> int | None:
        """The smoothed round trip; None before its handshake is over."""
        return self._sender.round_trips.smoothed_ns

    def send(self, packet: Packet) -> None:
        """Write a message to the stream."""
        self._stream.write(packet.packet_id, packet.size_bytes)
        self._sender.written()

    def receive(self, host: str, segment: Segment) -> None:
        """Take a segment that arrived at one of the ends."""
        if host == self._name.destination:
            self._receiver.receive(segment)
        else:
            self._sender.receive(segment)

    def _to_destination(self, segment: Segment) -> None:
        name = self._name
        kind = "data" if segment.length else "syn" if segment.syn else "open"
        self._transmit(name.source, name.destination, kind, segment)

    def _to_source(self, segment: Segment) -> None:
        name = self._name
        self._transmit(name.destination, name.source, "syn-ack" if segment.syn else "ack", segment)

    def _transmit(self, source: str, destination: str, kind: str, segment: Segment) -> None:
        # Draws are for what is sent the so-manieth time; an ACK is told by the segment that it answers.
        stream = f"{self._name.flow} {self._name.number} {kind} {segment.times}"
        identity = stream, segment.number
        body = self._name, segment
        self._wire.transmit(IpPacket(source, destination, "tcp", segment.size_bytes, identity, body))

    def _read(self, upto: int) -> None:
        for packet_id in self._stream.read(upto):
            self._wire.deliver(packet_id)

    def _give_up(self, reason: str) -> None:
        self._sender.close()
        for packet_id in self._stream.unread():
            self._wire.drop(packet_id, reason)
        self._closed(self._name)

    def _note(self, event: str) -> None:
        if self._log is None:
            return
        control, round_trips = self._sender.control, self._sender.round_trips
        self._log(
            TcpSample(
                self._wire.now_ns,
                self._name,
                event,
                control.window_bytes,
                control.threshold_bytes,
                self._sender.board.pipe_bytes,
                round_trips.smoothed_ns,
                round_trips.timeout_ns,
            )
        )
