"""TCP as a transport: messages of programs over one connection per flow.

A program's messages are written to the stream of its flow's connection, which is opened by the first message and
stays open. A message is delivered when its last byte has been read, in order, at its destination. When a connection
is given up, undelivered messages are dropped; the next message opens another connection.

Standards: RFC 9293 with 2018, 3042, 5681, 6298, 6582, 6675, 6928, 6937, 7323, 8985 and 9438. The default is the TCP
of Linux without tail loss probes (RFC 8985, 7), undo after a spurious timeout (RFC 5682), HyStart (RFC 9406),
duplicate SACKs (RFC 2883), ECN, pacing, full send buffers, keep-alive, and closing. A receiver does not retransmit
its SYN-ACK: the sender retransmits its SYN. Windows count bytes; those of Linux's CUBIC are whole segments.
"""

from fieldkit.core.errors import ConfigurationError
from sim_backends.network.packets import Packet
from sim_backends.network.tcp.connection import ConnectionName, TcpConnection, TcpLog
from sim_backends.network.tcp.options import TcpOptions
from sim_backends.network.wire import IpPacket, Wire


class Tcp:
    """Carries messages in order, once and complete, or gives up; implements the protocol `Transport`.

    Args:
        wire: The network below.
        options: Options of all its connections.
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

    def lost(self, packet: IpPacket, reason: str) -> None:
        """Implement `Transport.lost`: a lost packet loses no message, because TCP retransmits."""

    def _remove(self, name: ConnectionName) -> None:
        del self._connections[name]
