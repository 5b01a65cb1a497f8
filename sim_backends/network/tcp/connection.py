"""TCP as a transport: each flow has a connection that carries the messages of programs.

A program's messages are written to the stream of its flow's connection, which is opened by the first message and
stays open. A message is delivered when its last byte has been read, in order, at its destination. When a connection
is given up, undelivered messages are dropped; the next message opens another connection.

The model follows RFC 9293, 2018, 3042, 5681, 6298, 6582, 6675, 6928, 6937, 7323, 8985 and 9438. By default it behaves
like the TCP of Linux. It does not model tail loss probes (RFC 8985, 7), undo after a spurious timeout (RFC 5682),
HyStart (RFC 9406), duplicate SACKs (RFC 2883), ECN, pacing, full send buffers, keep-alive, and closing. A receiver
does not retransmit its SYN-ACK: the sender retransmits its SYN. Windows count bytes; the windows of Linux's CUBIC are
whole segments.
"""

from collections.abc import Callable
from dataclasses import dataclass

from fieldkit.core.errors import ConfigurationError
from sim_backends.network.packets import Packet
from sim_backends.network.tcp.receiver import Receiver
from sim_backends.network.tcp.segments import MessageStream, Segment
from sim_backends.network.tcp.sender import Sender
from sim_backends.network.tcp.tcp_options import TcpOptions
from sim_backends.network.wire import IpPacket, Wire


@dataclass(frozen=True, slots=True)
class ConnectionName:
    """The name of a connection, in place of addresses and ports.

    Attributes:
        source: Name of the sender.
        destination: Name of the receiver.
        flow: Name of the flow.
        number: Number of the connection in the flow, from 0.
    """

    source: str
    destination: str
    flow: str
    number: int


@dataclass(frozen=True, slots=True)
class TcpSample:
    """The state of a sender after an event.

    Attributes:
        at_ns: Time of the event.
        connection: Name of the connection.
        event: The event: `ack`, `loss`, `timeout`, `idle`.
        window_bytes: Congestion window.
        threshold_bytes: Slow-start threshold; None if it is unlimited.
        flight_bytes: Estimate of the bytes in flight.
        round_trip_ns: Smoothed round trip; None before the first measurement.
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
    """One connection, open or being opened, which carries messages in one direction.

    The reverse direction of the same connection is a second object, which is open from the start. ACKs of the first
    object and data of the second object are never combined in one packet.

    Args:
        wire: The network below.
        options: Options of TCP.
        name: Its name.
        on_closed: Called after the connection was given up and its messages were dropped.
        log: Called with the state of the sender after every event; None for no log.
        round_trip_ns: Round trip measured by the handshake of a connection that is already open; None opens a new
            one.
    """

    def __init__(
        self,
        wire: Wire,
        options: TcpOptions,
        name: ConnectionName,
        *,
        on_closed: Callable[[ConnectionName], None],
        log: TcpLog | None,
        round_trip_ns: int | None = None,
    ) -> None:
        self._wire = wire
        self._name = name
        self._on_closed = on_closed
        self._log = log
        self._stream = MessageStream(options.segment_bytes)
        self._receiver = Receiver(
            wire,
            name.destination,
            options,
            transmit=self._send_to_source,
            on_readable=self._read,
            is_open=round_trip_ns is not None,
        )
        self._sender = Sender(
            wire,
            name.source,
            options,
            self._stream,
            transmit=self._send_to_destination,
            give_up=self._give_up,
            log=self._log_event,
            round_trip_ns=round_trip_ns,
        )

    @property
    def round_trip_ns(self) -> int | None:
        """The smoothed round trip; None before the handshake is complete."""
        return self._sender.round_trips.smoothed_ns

    def send(self, packet: Packet) -> None:
        """Write a message to the stream."""
        self._stream.write(packet.packet_id, packet.size_bytes)
        self._sender.on_written()

    def receive(self, host: str, segment: Segment) -> None:
        """Process a segment that arrived at one of the ends."""
        if host == self._name.destination:
            self._receiver.receive(segment)
        else:
            self._sender.receive(segment)

    def _send_to_destination(self, segment: Segment) -> None:
        name = self._name
        kind = "data" if segment.length else "syn" if segment.syn else "open"
        self._transmit(name.source, name.destination, kind, segment)

    def _send_to_source(self, segment: Segment) -> None:
        name = self._name
        self._transmit(name.destination, name.source, "syn-ack" if segment.syn else "ack", segment)

    def _transmit(self, source: str, destination: str, kind: str, segment: Segment) -> None:
        # Random numbers are derived from the number of earlier transmissions, so that they differ between
        # transmissions. An ACK is identified by the segment that it acknowledges.
        stream = f"{self._name.flow} {self._name.number} {kind} {segment.earlier_transmissions}"
        identity = stream, segment.number
        body = self._name, segment
        self._wire.transmit(IpPacket(source, destination, "tcp", segment.size_bytes, identity, body))

    def _read(self, end: int) -> None:
        for packet_id in self._stream.read(end):
            self._wire.deliver(packet_id)

    def _give_up(self, reason: str) -> None:
        self._sender.close()
        for packet_id in self._stream.unread():
            self._wire.drop(packet_id, reason)
        self._on_closed(self._name)

    def _log_event(self, event: str) -> None:
        """Pass the state of the sender to the log."""
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
                self._sender.scoreboard.pipe_bytes,
                round_trips.smoothed_ns,
                round_trips.timeout_ns,
            )
        )


class Tcp:
    """Delivers each message once, complete and in order, or gives up its connection; a `Transport`.

    Args:
        wire: The network below.
        options: Options of all its connections; None for the defaults.
        log: Called with the state of a sender after every event; None for no log.
    """

    def __init__(self, wire: Wire, options: TcpOptions | None = None, *, log: TcpLog | None = None) -> None:
        self._wire = wire
        self._options = options or TcpOptions()
        self._log = log
        self._names: dict[tuple[str, str, str], ConnectionName] = {}
        self._connections: dict[ConnectionName, TcpConnection] = {}

    def send(self, packet: Packet, *, reverse_of: str | None = None) -> None:
        """Implement `Transport.send`.

        Args:
            packet: The message.
            reverse_of: A flow from the destination to the source whose connection is used in the reverse direction
                while it is open; None for a separate connection with its own handshake.

        Raises:
            ConfigurationError: The message is empty, which a stream cannot carry, or its destination is its source.
        """
        source, destination, (flow, number) = packet.source, packet.destination, packet.identity
        if packet.size_bytes < 1 or source == destination:
            raise ConfigurationError(
                f"TCP cannot carry {packet.size_bytes} bytes from {source} to {destination}",
                where=f"packet {number} of flow {flow}",
                remedy="send at least 1 byte, to another agent",
            )
        name = self._names.get((source, destination, flow))
        if name is None or name not in self._connections:
            name = ConnectionName(source, destination, flow, name.number + 1 if name else 0)
            self._names[source, destination, flow] = name
            self._connections[name] = TcpConnection(
                self._wire,
                self._options,
                name,
                on_closed=self._remove,
                log=self._log,
                round_trip_ns=self._round_trip_ns(destination, source, reverse_of),
            )
        self._connections[name].send(packet)

    def _round_trip_ns(self, source: str, destination: str, flow: str | None) -> int | None:
        name = None if flow is None else self._names.get((source, destination, flow))
        connection = None if name is None else self._connections.get(name)
        return None if connection is None else connection.round_trip_ns

    def receive(self, host: str, packet: IpPacket) -> None:
        """Implement `Transport.receive`; packets of a connection that was given up are ignored."""
        name, segment = packet.body
        connection = self._connections.get(name)
        if connection is not None:
            connection.receive(host, segment)

    def record_loss(self, packet: IpPacket, reason: str) -> None:
        """Implement `Transport.record_loss`: a lost packet loses no message, because TCP retransmits."""

    def _remove(self, name: ConnectionName) -> None:
        del self._connections[name]
