"""TCP as a transport: messages of programs over one connection per flow.

What a program sends is written to the stream of its flow's connection, which the first message opens and which
stays open. A message is delivered when its last byte has been read, in order, at its destination. A connection that
is given up drops what was not delivered; the next message opens another one.

Standards: RFC 9293 with 2018, 3042, 5681, 6298, 6582, 6675, 6928, 6937, 7323, 8985 and 9438. By default it is that of
Linux, without tail loss probes (RFC 8985, 7), undoing what a needless timeout did (RFC 5682), HyStart (RFC 9406),
duplicate SACKs (RFC 2883), ECN, pacing, full send buffers, keep-alive, and closing. A receiver does not send its
SYN-ACK again by itself: the sender asks again. Windows count bytes; those of Linux's CUBIC are whole segments.
"""

from fieldkit.core.errors import ConfigurationError
from sim_backends.network.packets import Packet
from sim_backends.network.tcp.connection import ConnectionName, TcpConnection, TcpLog
from sim_backends.network.tcp.options import TcpOptions
from sim_backends.network.wire import IpPacket, Wire


class Tcp:
    """Carries messages in order, once, complete, or gives up; keeps the protocol `Transport`.

    Args:
        wire: What it stands on.
        options: Of all its connections.
        log: Handed the state of a sender after everything that happened to it; None for nobody.
    """

    def __init__(self, wire: Wire, options: TcpOptions | None = None, *, log: TcpLog | None = None) -> None:
        self._wire = wire
        self._options = options or TcpOptions()
        self._log = log
        self._names: dict[tuple[str, str, str], ConnectionName] = {}
        self._connections: dict[ConnectionName, TcpConnection] = {}

    def send(self, packet: Packet, *, back_of: str | None = None) -> None:
        """See `Transport.send`.

        Args:
            packet: The message.
            back_of: The flow from its destination to its source whose connection it goes back on, while that is open;
                None for a connection of its own, with a handshake.

        Raises:
            ConfigurationError: The message is empty, which a stream cannot carry, or for its own source.
        """
        source, destination, (flow, number) = packet.source, packet.destination, packet.identity
        if packet.size_bytes < 1 or source == destination:
            raise ConfigurationError(
                f"TCP cannot carry {packet.size_bytes} bytes from {source} to {destination}",
                where=f"packet {number} of flow {flow}",
                remedy="send at least 1 byte, to somebody else",
            )
        name = self._names.get((source, destination, flow))
        if name is None or name not in self._connections:
            name = ConnectionName(source, destination, flow, name.number + 1 if name else 0)
            self._names[source, destination, flow] = name
            self._connections[name] = TcpConnection(
                self._wire,
                self._options,
                name,
                closed=self._forget,
                log=self._log,
                round_trip_ns=self._round_trip_ns(destination, source, back_of),
            )
        self._connections[name].send(packet)

    def _round_trip_ns(self, source: str, destination: str, flow: str | None) -> int | None:
        name = None if flow is None else self._names.get((source, destination, flow))
        connection = None if name is None else self._connections.get(name)
        return None if connection is None else connection.round_trip_ns

    def receive(self, host: str, packet: IpPacket) -> None:
        """See `Transport.receive`; what belongs to a connection that was given up is ignored."""
        name, segment = packet.body
        connection = self._connections.get(name)
        if connection is not None:
            connection.receive(host, segment)

    def lost(self, packet: IpPacket, reason: str) -> None:
        """See `Transport.lost`: a message is lost only with its connection, so this is none."""

    def _forget(self, name: ConnectionName) -> None:
        del self._connections[name]
