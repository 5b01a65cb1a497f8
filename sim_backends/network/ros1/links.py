"""Links from a publisher to a subscriber of ROS 1: TCPROS and UDPROS."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Final

from sim_backends.network.packets import Packet
from sim_backends.network.ros1.ros1_options import LENGTH_BYTES, Ros1Flow, Ros1Options
from sim_backends.network.ros1.streams import LossCallback, TcpStreams
from sim_backends.network.wire import IpPacket, Wire, WireTimer

TRANSPORT: Final = "ros1"
"""Name of the transport, as in packets of programs."""
NOT_CONNECTED: Final = "no subscriber is connected"
GIVEN_UP: Final = "the subscriber has given up this connection"
OUT_OF_ORDER: Final = "blocks of UDPROS out of order"
_PROBE_BYTES: Final = 20 + 32
"""Size of a TCP segment without data, with timestamps and the IP header."""
_UDP_BYTES: Final = 20 + 8
"""Size of the headers of IP and UDP."""
_UDPROS_HEADER_BYTES: Final = 8


@dataclass(frozen=True, slots=True)
class Probe:
    """A keep-alive probe that a subscriber sends on a connection, or the publisher's response.

    Attributes:
        flow: Flow of the connection.
        connection: Number of the connection, from 1.
        number: Number of the probe.
        is_alive: The response: True if this connection is open at the publisher. None in a probe.
    """

    flow: str
    connection: int
    number: int
    is_alive: bool | None = None


@dataclass(frozen=True, slots=True)
class Block:
    """A datagram of UDPROS, which carries a part of a message.

    Attributes:
        flow: Name of the flow.
        packet_id: Number of the message.
        index: Index of the block in the message.
        block_count: Number of blocks of the message.
    """

    flow: str
    packet_id: int
    index: int
    block_count: int


class TcprosLink:
    """Messages over a TCP connection that the subscriber opens with an exchange of headers.

    Args:
        wire: Provides the clock, and receives the results of messages.
        streams: Carries the messages.
        name: Name of the flow.
        flow: Publisher and subscriber.
        options: Options of the nodes.
    """

    def __init__(self, wire: Wire, streams: TcpStreams, name: str, flow: Ros1Flow, options: Ros1Options) -> None:
        self._wire = wire
        self._streams = streams
        self._name = name
        self._flow = flow
        self._options = options
        self._downstream = flow.publisher, flow.subscriber
        self._retry_ns = options.reconnect.first_ns
        # Number of the connection that is open at each end; 0 if no connection is open there.
        self._publisher_connection = 0
        self._subscriber_connection = 0
        self._connection_count = 0
        self._unanswered_probes = 0
        self._probe_count = 0
        self._silence_timer = WireTimer(wire, flow.subscriber, self._probe)

    def accept(self) -> None:
        """Do nothing: the subscriber opens the connection, to the address in the publisher's response."""

    def connect(self) -> None:
        """Open a connection from the subscriber, which has received the publisher's address."""
        self._connection_count += 1
        connection = self._subscriber_connection = self._connection_count
        self._reset_silence_timer()
        upstream = self._flow.subscriber, self._flow.publisher
        accept, reconnect = partial(self._accept, connection), partial(self._reconnect_later, connection)
        size_bytes = LENGTH_BYTES + self._flow.header_bytes
        self._streams.send(upstream, f"{self._name} {connection}", size_bytes, accept, reconnect)

    def publish(self, packet: Packet) -> None:
        """Send a message from the publisher."""
        if not self._publisher_connection:
            self._wire.drop(packet.packet_id, NOT_CONNECTED)
            return
        connection, packet_id = self._publisher_connection, packet.packet_id
        arrive = partial(self._arrive, connection, packet_id)
        self._send(
            connection, LENGTH_BYTES + packet.size_bytes, arrive, partial(self._drop_and_close, connection, packet_id)
        )

    def receive(self, packet: IpPacket) -> None:
        """Process a probe or its response."""
        probe: Probe = packet.body
        if probe.is_alive is None:
            is_alive = probe.connection == self._publisher_connection
            self._emit(self._downstream, Probe(self._name, probe.connection, probe.number, is_alive))
        elif not probe.is_alive:
            self._reconnect_later(probe.connection, "")
        elif probe.connection == self._subscriber_connection:
            self._reset_silence_timer()

    def record_loss(self, packet: IpPacket, reason: str) -> None:
        """Ignore the loss of a probe."""

    def _accept(self, connection: int) -> None:
        """Process the subscriber's header at the publisher, and send the publisher's header."""
        if connection < self._publisher_connection:
            return  # The subscriber has since opened another connection.
        self._publisher_connection = connection
        size_bytes = LENGTH_BYTES + self._flow.header_bytes
        self._send(connection, size_bytes, partial(self._open, connection), partial(self._close, connection))

    def _open(self, connection: int) -> None:
        """Process the publisher's header at the subscriber."""
        if connection == self._subscriber_connection:
            self._retry_ns = self._options.reconnect.first_ns
            self._reset_silence_timer()

    def _reconnect_later(self, connection: int, reason: str) -> None:  # noqa: ARG002 (see LossCallback)
        """Give up the connection at the subscriber and open another one later, unless it was already given up."""
        if connection != self._subscriber_connection:
            return
        self._subscriber_connection = 0
        self._silence_timer.stop()
        retry_ns, self._retry_ns = self._retry_ns, min(2 * self._retry_ns, self._options.reconnect.longest_ns)
        self._wire.at(self._wire.now_ns + retry_ns, self._flow.subscriber, self.connect)

    def _close(self, connection: int, reason: str) -> None:  # noqa: ARG002 (see LossCallback)
        """Close a connection at the publisher after its TCP has given up the connection."""
        if connection == self._publisher_connection:
            self._publisher_connection = 0

    def _drop_and_close(self, connection: int, packet_id: int, reason: str) -> None:
        self._wire.drop(packet_id, reason)
        self._close(connection, reason)

    def _arrive(self, connection: int, packet_id: int) -> None:
        """Deliver a message to the subscriber."""
        if connection == self._subscriber_connection:
            self._wire.deliver(packet_id)
            self._reset_silence_timer()
        else:
            self._wire.drop(packet_id, GIVEN_UP)

    def _reset_silence_timer(self) -> None:
        self._unanswered_probes = 0
        self._silence_timer.set(self._wire.now_ns + self._options.silence_ns)

    def _probe(self) -> None:
        """Probe the connection from the subscriber, or give up the connection after too many probes."""
        if self._unanswered_probes == self._options.probes:
            self._reconnect_later(self._subscriber_connection, "")
            return
        self._unanswered_probes += 1
        self._probe_count += 1
        upstream = self._flow.subscriber, self._flow.publisher
        self._emit(upstream, Probe(self._name, self._subscriber_connection, self._probe_count))
        self._silence_timer.set(self._wire.now_ns + self._options.probe_ns)

    def _send(
        self, connection: int, size_bytes: int, on_delivered: Callable[[], None], on_lost: LossCallback
    ) -> None:
        self._streams.send(
            self._downstream, f"{self._name} {connection}", size_bytes, on_delivered, on_lost, reverse=True
        )

    def _emit(self, ends: tuple[str, str], probe: Probe) -> None:
        source, destination = ends
        if source == destination:
            self._reset_silence_timer()
            return
        kind = "probe" if probe.is_alive is None else "probe answer"
        identity = f"{self._name} {kind}", probe.number
        self._wire.transmit(IpPacket(source, destination, TRANSPORT, _PROBE_BYTES, identity, probe))


class UdprosLink:
    """Messages in datagrams, without retransmission.

    Blocks of a message must arrive in order; if one is late or lost, the whole message is lost.

    Args:
        wire: The network below.
        name: Name of the flow.
        flow: Publisher and subscriber.
        options: Options of the nodes.

    Attributes:
        is_connected: True if the publisher has a subscriber.
    """

    def __init__(self, wire: Wire, name: str, flow: Ros1Flow, options: Ros1Options) -> None:
        self._wire = wire
        self._name = name
        self._flow = flow
        self._payload_bytes = options.datagram_bytes - _UDPROS_HEADER_BYTES
        # The message that the subscriber is reassembling, and the index of the next block.
        self._current_packet_id = -1
        self._next_block = 0
        # Messages that have neither been delivered nor lost.
        self._pending_ids: set[int] = set()
        self.is_connected = False

    def connect(self) -> None:
        """Do nothing: the publisher sends to the address in the subscriber's request."""

    def accept(self) -> None:
        """Add the subscriber at the publisher."""
        self.is_connected = True

    def publish(self, packet: Packet) -> None:
        """Send a message from the publisher."""
        if not self.is_connected:
            self._wire.drop(packet.packet_id, NOT_CONNECTED)
            return
        source, destination = self._flow.publisher, self._flow.subscriber
        packet_id, (_, number) = packet.packet_id, packet.identity
        remaining_bytes = LENGTH_BYTES + packet.size_bytes
        block_count = -(-remaining_bytes // self._payload_bytes)
        self._pending_ids.add(packet_id)
        for index in range(block_count):
            payload_bytes = min(remaining_bytes, self._payload_bytes)
            remaining_bytes -= payload_bytes
            size_bytes = _UDP_BYTES + _UDPROS_HEADER_BYTES + payload_bytes
            identity = f"{self._name} block{index}", number
            block = Block(self._name, packet_id, index, block_count)
            self._wire.transmit(IpPacket(source, destination, TRANSPORT, size_bytes, identity, block))

    def receive(self, packet: IpPacket) -> None:
        """Process a datagram at the subscriber."""
        block: Block = packet.body
        if block.index == 0 and block.packet_id != self._current_packet_id:
            self._current_packet_id, self._next_block = block.packet_id, 0
        if block.packet_id != self._current_packet_id or block.index != self._next_block:
            self._drop(block.packet_id, OUT_OF_ORDER)
            return
        self._next_block += 1
        if self._next_block == block.block_count:
            self._next_block = 0
            self._current_packet_id = -1
            if block.packet_id in self._pending_ids:
                self._pending_ids.remove(block.packet_id)
                self._wire.deliver(block.packet_id)

    def record_loss(self, packet: IpPacket, reason: str) -> None:
        """Record, for statistics only, that a datagram will not arrive."""
        self._drop(packet.body.packet_id, reason)

    def _drop(self, packet_id: int, reason: str) -> None:
        if packet_id in self._pending_ids:
            self._pending_ids.remove(packet_id)
            self._wire.drop(packet_id, reason)
