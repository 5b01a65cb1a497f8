"""Links from a publisher to a subscriber of ROS 1: TCPROS and UDPROS."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

from sim_backends.network.packets import Packet
from sim_backends.network.ros1.options import LENGTH_BYTES, Ros1Flow, Ros1Options
from sim_backends.network.ros1.streams import Lost, TcpStreams
from sim_backends.network.timer import WireTimer
from sim_backends.network.wire import IpPacket, Wire

TRANSPORT: Final = "ros1"
"""Name of the transport, as packets of programs have it."""
NOT_CONNECTED: Final = "no subscriber is connected"
GIVEN_UP: Final = "the subscriber has given this connection up"
OUT_OF_ORDER: Final = "blocks of UDPROS out of order"
_PROBE_BYTES: Final = 20 + 32
"""A segment of TCP without data, with timestamps."""
_UDP_BYTES: Final = 20 + 8
_UDPROS_HEADER_BYTES: Final = 8


@dataclass(frozen=True, slots=True)
class Probe:
    """Asks whether a connection is alive, or answers that.

    Attributes:
        flow: Whose connection.
        connection: Which, from 1.
        number: Which probe.
        alive: The answer; None asks.
    """

    flow: str
    connection: int
    number: int
    alive: bool | None = None


@dataclass(frozen=True, slots=True)
class Block:
    """A datagram of UDPROS.

    Attributes:
        flow: Of which flow.
        packet_id: Of the message.
        index: Which block of it.
        of: How many it has.
    """

    flow: str
    packet_id: int
    index: int
    of: int


class TcprosLink:
    """Messages over a TCP connection that the subscriber opens, after an exchange of headers.

    Args:
        wire: Keeps the time, and tells what became of messages.
        streams: What messages go over.
        name: Of the flow.
        flow: Who publishes to whom.
        options: Of the nodes.
    """

    def __init__(self, wire: Wire, streams: TcpStreams, name: str, flow: Ros1Flow, options: Ros1Options) -> None:
        self._wire = wire
        self._streams = streams
        self._name = name
        self._flow = flow
        self._options = options
        self._down = flow.publisher, flow.subscriber
        self._retry_ns = options.reconnect.first_ns
        # Which connection each end takes to be open; 0 for none.
        self._of_publisher = 0
        self._of_subscriber = 0
        self._opened = 0
        self._unanswered = 0
        self._probed = 0
        self._silence = WireTimer(wire, flow.subscriber, self._probe)

    def accept(self) -> None:
        """Do nothing, at the publisher: it has told the subscriber where it listens."""

    def begin(self) -> None:
        """Open a connection, at the subscriber, which has learned from the publisher where."""
        self._opened += 1
        opened = self._of_subscriber = self._opened
        self._hear()
        up = self._flow.subscriber, self._flow.publisher
        accept, give_up = partial(self._accept, opened), partial(self._give_up, opened)
        size_bytes = LENGTH_BYTES + self._flow.header_bytes
        self._streams.send(up, f"{self._name} {opened}", size_bytes, accept, give_up)

    def publish(self, packet: Packet) -> None:
        """Send a message, at the publisher."""
        if not self._of_publisher:
            self._wire.drop(packet.packet_id, NOT_CONNECTED)
            return
        connection, packet_id = self._of_publisher, packet.packet_id
        arrive = partial(self._arrive, connection, packet_id)
        self._send(connection, LENGTH_BYTES + packet.size_bytes, arrive, partial(self._lose, connection, packet_id))

    def receive(self, packet: IpPacket) -> None:
        """Take a probe, or an answer to one."""
        probe: Probe = packet.body
        if probe.alive is None:
            alive = probe.connection == self._of_publisher
            self._emit(self._down, Probe(self._name, probe.connection, probe.number, alive))
        elif not probe.alive:
            self._give_up(probe.connection, "")
        elif probe.connection == self._of_subscriber:
            self._hear()

    def lost(self, packet: IpPacket, reason: str) -> None:
        """Learn that a probe will not arrive, which changes nothing."""

    def _accept(self, connection: int) -> None:
        """Take the subscriber's header, at the publisher, and answer by one's own."""
        if connection < self._of_publisher:
            return  # It has opened another since.
        self._of_publisher = connection
        size_bytes = LENGTH_BYTES + self._flow.header_bytes
        self._send(connection, size_bytes, partial(self._open, connection), partial(self._close, connection))

    def _open(self, connection: int) -> None:
        """Take the publisher's header, at the subscriber."""
        if connection == self._of_subscriber:
            self._retry_ns = self._options.reconnect.first_ns
            self._hear()

    def _give_up(self, connection: int, reason: str) -> None:  # noqa: ARG002 (see Lost)
        """Open another connection later, at the subscriber, unless that has been done."""
        if connection != self._of_subscriber:
            return
        self._of_subscriber = 0
        self._silence.stop()
        retry_ns, self._retry_ns = self._retry_ns, min(2 * self._retry_ns, self._options.reconnect.longest_ns)
        self._wire.at(self._wire.now_ns + retry_ns, self._flow.subscriber, self.begin)

    def _close(self, connection: int, reason: str) -> None:  # noqa: ARG002 (see Lost)
        """Forget a connection, at the publisher, whose TCP has given it up."""
        if connection == self._of_publisher:
            self._of_publisher = 0

    def _lose(self, connection: int, packet_id: int, reason: str) -> None:
        self._wire.drop(packet_id, reason)
        self._close(connection, reason)

    def _arrive(self, connection: int, packet_id: int) -> None:
        """Take a message, at the subscriber."""
        if connection == self._of_subscriber:
            self._wire.deliver(packet_id)
            self._hear()
        else:
            self._wire.drop(packet_id, GIVEN_UP)

    def _hear(self) -> None:
        self._unanswered = 0
        self._silence.set(self._wire.now_ns + self._options.silence_ns)

    def _probe(self) -> None:
        """Ask whether the connection is alive, at the subscriber, or give it up."""
        if self._unanswered == self._options.probes:
            self._give_up(self._of_subscriber, "")
            return
        self._unanswered += 1
        self._probed += 1
        up = self._flow.subscriber, self._flow.publisher
        self._emit(up, Probe(self._name, self._of_subscriber, self._probed))
        self._silence.set(self._wire.now_ns + self._options.probe_ns)

    def _send(self, connection: int, size_bytes: int, delivered: Callable[[], None], lost: Lost) -> None:
        self._streams.send(self._down, f"{self._name} {connection}", size_bytes, delivered, lost, back=True)

    def _emit(self, ends: tuple[str, str], probe: Probe) -> None:
        source, destination = ends
        if source == destination:
            self._hear()
            return
        kind = "probe" if probe.alive is None else "probe answer"
        identity = f"{self._name} {kind}", probe.number
        self._wire.transmit(IpPacket(source, destination, TRANSPORT, _PROBE_BYTES, identity, probe))


class UdprosLink:
    """Messages in datagrams, of which nobody asks for one again.

    Blocks of a message must come in order, and one that comes too late or not takes the message with it.

    Args:
        wire: What datagrams go over.
        name: Of the flow.
        flow: Who publishes to whom.
        options: Of the nodes.

    Attributes:
        connected: Whether the publisher knows of its subscriber.
    """

    def __init__(self, wire: Wire, name: str, flow: Ros1Flow, options: Ros1Options) -> None:
        self._wire = wire
        self._name = name
        self._flow = flow
        self._payload_bytes = options.datagram_bytes - _UDPROS_HEADER_BYTES
        # The message that the subscriber puts together, and the block that it expects.
        self._current = -1
        self._next = 0
        self._open: set[int] = set()
        self.connected = False

    def begin(self) -> None:
        """Do nothing, at the subscriber: it has told the publisher where it listens."""

    def accept(self) -> None:
        """Take it, at the publisher, that there is a subscriber."""
        self.connected = True

    def publish(self, packet: Packet) -> None:
        """Send a message, at the publisher."""
        if not self.connected:
            self._wire.drop(packet.packet_id, NOT_CONNECTED)
            return
        source, destination = self._flow.publisher, self._flow.subscriber
        packet_id, (_, number) = packet.packet_id, packet.identity
        left_bytes = LENGTH_BYTES + packet.size_bytes
        of = -(-left_bytes // self._payload_bytes)
        self._open.add(packet_id)
        for index in range(of):
            payload_bytes = min(left_bytes, self._payload_bytes)
            left_bytes -= payload_bytes
            size_bytes = _UDP_BYTES + _UDPROS_HEADER_BYTES + payload_bytes
            identity = f"{self._name} block{index}", number
            block = Block(self._name, packet_id, index, of)
            self._wire.transmit(IpPacket(source, destination, TRANSPORT, size_bytes, identity, block))

    def receive(self, packet: IpPacket) -> None:
        """Take a datagram, at the subscriber."""
        block: Block = packet.body
        if block.index == 0 and block.packet_id != self._current:
            self._current, self._next = block.packet_id, 0
        if block.packet_id != self._current or block.index != self._next:
            self._drop(block.packet_id, OUT_OF_ORDER)
            return
        self._next += 1
        if self._next == block.of:
            self._next = 0
            self._current = -1
            if block.packet_id in self._open:
                self._open.remove(block.packet_id)
                self._wire.deliver(block.packet_id)

    def lost(self, packet: IpPacket, reason: str) -> None:
        """Learn, for the account, that a datagram will not arrive."""
        self._drop(packet.body.packet_id, reason)

    def _drop(self, packet_id: int, reason: str) -> None:
        if packet_id in self._open:
            self._open.remove(packet_id)
            self._wire.drop(packet_id, reason)
