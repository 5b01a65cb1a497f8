"""Messages of ROS 1's own over TCP: a transport that stands on another one."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from sim_backends.network.packets import Packet
from sim_backends.network.tcp.options import TcpOptions
from sim_backends.network.tcp.transport import Tcp
from sim_backends.network.wire import IpPacket, Wire

Lost = Callable[[str], None]
"""Called with the reason."""


class TcpStreams:
    """Carries messages by TCP connections, and tells each end what its own TCP does.

    To its TCP it is the `Wire`; on the wire below, segments are packets of the transport that it belongs to.

    Args:
        wire: What segments go over.
        transport: Name of the transport that gets their arrivals.
        options: Of TCP.

    Attributes:
        now_ns: See `Wire`.
    """

    def __init__(self, wire: Wire, transport: str, options: TcpOptions) -> None:
        self.now_ns = wire.now_ns
        self._wire = wire
        self._transport = transport
        self._tcp = Tcp(self, options)
        self._sent = 0
        self._under_way: dict[int, tuple[Callable[[], None], Lost]] = {}

    def send(
        self,
        ends: tuple[str, str],
        connection: str,
        size_bytes: int,
        delivered: Callable[[], None],
        lost: Lost,
        *,
        back: bool = False,
    ) -> None:
        """Send a message from one end to the other.

        Args:
            ends: Source and destination; within one host a message arrives at once.
            connection: Name of the connection, which is opened by its first message and after it was given up.
            size_bytes: Of the message.
            delivered: Called when it is whole at the destination.
            lost: Called when its connection was given up before.
            back: Whether it goes to who opened the connection.
        """
        source, destination = ends
        if source == destination:
            self._wire.at(self._wire.now_ns, source, delivered)
            return
        self.now_ns = self._wire.now_ns
        self._sent += 1
        self._under_way[self._sent] = delivered, lost
        self._tcp.send(
            Packet(
                self._sent,
                source,
                destination,
                size_bytes,
                (f"{connection} back" if back else connection, self._sent),
                self.now_ns,
                self.now_ns,
                self._transport,
            ),
            back_of=connection if back else None,
        )

    def receive(self, host: str, packet: IpPacket) -> None:
        """Take a segment that arrived at `host`."""
        self.now_ns = self._wire.now_ns
        self._tcp.receive(host, packet)

    def transmit(self, packet: IpPacket) -> None:
        """See `Wire.transmit`."""
        self._wire.transmit(replace(packet, transport=self._transport))

    def at(self, at_ns: int, host: str, call: Callable[[], None]) -> None:
        """See `Wire.at`."""
        self._wire.at(at_ns, host, partial(self._ring, call))

    def deliver(self, packet_id: int) -> None:
        """See `Wire.deliver`."""
        delivered, _ = self._under_way.pop(packet_id)
        delivered()

    def drop(self, packet_id: int, reason: str) -> None:
        """See `Wire.drop`."""
        _, lost = self._under_way.pop(packet_id)
        lost(reason)

    def _ring(self, call: Callable[[], None]) -> None:
        self.now_ns = self._wire.now_ns
        call()
