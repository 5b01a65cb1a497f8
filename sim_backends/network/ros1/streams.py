"""Messages of ROS 1 over TCP (a transport on top of another transport), and calls by XML-RPC.

Calls between nodes and their master are requests and responses over TCP, with retries.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from sim_backends.network.packets import Packet
from sim_backends.network.tcp.connection import Tcp
from sim_backends.network.tcp.tcp_options import TcpOptions
from sim_backends.network.wire import IpPacket, Wire

LossCallback = Callable[[str], None]
"""Called with the reason of a loss."""


class TcpStreams:
    """Carries messages over TCP connections, and reports delivery and loss to the ends by callbacks.

    This object is the `Wire` of the TCP that it uses. On the wire below, segments are packets of the transport to
    which this object belongs.

    Args:
        wire: The network below.
        transport: Name of the transport that receives the arriving packets.
        options: Options of TCP.

    Attributes:
        now_ns: Current simulated time.
    """

    def __init__(self, wire: Wire, transport: str, options: TcpOptions) -> None:
        self.now_ns = wire.now_ns
        self._wire = wire
        self._transport = transport
        self._tcp = Tcp(self, options)
        self._message_count = 0
        self._in_flight: dict[int, tuple[Callable[[], None], LossCallback]] = {}

    def send(
        self,
        ends: tuple[str, str],
        connection: str,
        size_bytes: int,
        on_delivered: Callable[[], None],
        on_lost: LossCallback,
        *,
        reverse: bool = False,
    ) -> None:
        """Send a message from one end to the other.

        Args:
            ends: Source and destination; within one host a message arrives immediately.
            connection: Name of the connection; its first message opens it, also after the connection was given up.
            size_bytes: Size of the message.
            on_delivered: Called when the message is complete at the destination.
            on_lost: Called if the connection is given up before that.
            reverse: True if the message is sent to the host that opened the connection.
        """
        source, destination = ends
        if source == destination:
            self._wire.at(self._wire.now_ns, source, on_delivered)
            return
        self.now_ns = self._wire.now_ns
        self._message_count += 1
        self._in_flight[self._message_count] = on_delivered, on_lost
        self._tcp.send(
            Packet(
                self._message_count,
                source,
                destination,
                size_bytes,
                (f"{connection} back" if reverse else connection, self._message_count),
                self.now_ns,
                self.now_ns,
                self._transport,
            ),
            reverse_of=connection if reverse else None,
        )

    def receive(self, host: str, packet: IpPacket) -> None:
        """Process a segment that arrived at `host`."""
        self.now_ns = self._wire.now_ns
        self._tcp.receive(host, packet)

    def transmit(self, packet: IpPacket) -> None:
        """Implement `Wire.transmit`."""
        self._wire.transmit(replace(packet, transport=self._transport))

    def at(self, at_ns: int, host: str, call: Callable[[], None]) -> None:
        """Implement `Wire.at`."""
        self._wire.at(at_ns, host, partial(self._call_now, call))

    def deliver(self, packet_id: int) -> None:
        """Implement `Wire.deliver`."""
        on_delivered, _ = self._in_flight.pop(packet_id)
        on_delivered()

    def drop(self, packet_id: int, reason: str) -> None:
        """Implement `Wire.drop`."""
        _, on_lost = self._in_flight.pop(packet_id)
        on_lost(reason)

    def _call_now(self, call: Callable[[], None]) -> None:
        self.now_ns = self._wire.now_ns
        call()


@dataclass(frozen=True, slots=True)
class CallResponse:
    """The response to a call.

    Attributes:
        size_bytes: Size of the response.
        on_received: Called at the caller when the response arrives.
    """

    size_bytes: int
    on_received: Callable[[], None]


@dataclass(frozen=True, slots=True)
class CallRetry:
    """Times of the retries of a call whose connection was given up.

    Attributes:
        first_ns: Delay of the first retry; it doubles for each further retry.
        longest_ns: Maximum delay.
    """

    first_ns: int
    longest_ns: int


class RemoteCalls:
    """Makes calls; a call is open until its response arrives or a connection that it uses is given up.

    Args:
        wire: Provides the clock.
        streams: Carries the calls. A host keeps its connection to another; some calls have a separate connection.
    """

    def __init__(self, wire: Wire, streams: TcpStreams) -> None:
        self._wire = wire
        self._streams = streams

    def call(
        self,
        caller: str,
        callee: str,
        size_bytes: int,
        serve: Callable[[], CallResponse],
        retry: CallRetry | None,
        *,
        topic: str = "",
    ) -> None:
        """Call from one host to another.

        Args:
            caller: The calling host.
            callee: The called host.
            size_bytes: Size of the request.
            serve: Executes the call at the callee and returns the response; a call that is repeated may be executed
                twice.
            retry: Times of retries; None for no retry.
            topic: Topic of the call if it has a separate connection, otherwise empty.
        """
        connection = f"xmlrpc {caller} {callee} {topic}".rstrip()

        def on_lost(reason: str) -> None:  # noqa: ARG001 (see LossCallback)
            if retry is not None:
                next_retry = CallRetry(min(2 * retry.first_ns, retry.longest_ns), retry.longest_ns)
                call_again = partial(self.call, caller, callee, size_bytes, serve, next_retry, topic=topic)
                self._wire.at(self._wire.now_ns + retry.first_ns, caller, call_again)

        def on_request() -> None:
            response = serve()
            self._streams.send(
                (callee, caller), connection, response.size_bytes, response.on_received, on_lost, reverse=True
            )

        self._streams.send((caller, callee), connection, size_bytes, on_request, on_lost)
