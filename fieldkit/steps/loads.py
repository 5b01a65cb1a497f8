"""Loads of iperf3 between two robots: their YAML keys and command lines.

Only options of iperf3 3.1 are used.
"""

from collections.abc import Iterator
from typing import Annotated, Final

from typing_extensions import override

from fieldkit.config import schema
from fieldkit.config.schema import Bits, Field, Int
from fieldkit.core.model import Protocol, Role
from fieldkit.measure.transfers.deliveries import FlowSchedule
from fieldkit.measure.transfers.iperf3_load import COOKIE_BYTES, LoadStreams
from fieldkit.steps.capabilities import HasNeeds
from fieldkit.steps.over_link import OverLink
from fieldkit.steps.scene import GOOD_BIT_S, Flow, Need, Scene, frames

PROGRAM: Final = "iperf3"

DEFAULT_UDP_BIT_S: Final = 1e6
"""Default rate of iperf3 for UDP."""

_BLOCK_BYTES: Final = 8192
"""Block size of TCP with a rate. With iperf3's default of 128 KiB, 2 Mbit/s would be two bursts per second."""


class LoadOptions(OverLink, HasNeeds):
    """A load from one robot to another.

    Attributes:
        sender: Role that runs the client, and sends.
        receiver: Role that runs the server, and receives.
        protocol: `tcp` or `udp`; without it, the protocol of the repeat.
        rate: Maximum rate of each stream, such as `5Mbit/s`. Without it, UDP sends 1 Mbit/s, and TCP as much as the
            link can carry.
        streams: Number of parallel streams.
        payload_bytes: UDP payload of a datagram.
        port: Port that the server listens on.
    """

    sender: Role = Field(alias="from")
    receiver: Role = Field(alias="to")
    protocol: Protocol | None = None
    rate: Annotated[Bits, Field(gt=0)] | None = None
    streams: Annotated[Int, Field(gt=0, le=128)] = 1
    payload_bytes: Annotated[Int, Field(ge=64, le=65507)] = 1400
    port: Annotated[Int, Field(gt=0, lt=65536)] = 5201

    @schema.model_validator(mode="after")
    def _has_two_ends(self) -> "LoadOptions":
        if self.sender == self.receiver:
            raise schema.validation_error(f"{self.sender} cannot send to itself; name another robot", "to")
        return self

    @override
    def needs(self, scene: Scene) -> Iterator[Need]:
        yield from self.route_needs(scene, self.sender, self.receiver)

    def transport_protocol(self, protocol: Protocol) -> Protocol:
        """Return the transport protocol of the load in repeats of `protocol`."""
        return self.protocol or protocol

    def server_command(self, *options: str) -> tuple[str, ...]:
        """Return the command of the server, which serves one test and exits."""
        return (PROGRAM, "-s", "-1", "-p", str(self.port), *options)

    def client_command(self, scene: Scene, *options: str) -> tuple[str, ...]:
        """Return the command of the client, which sends the load."""
        is_udp = self.transport_protocol(scene.protocol) is Protocol.UDP
        rate = self.rate or (DEFAULT_UDP_BIT_S if is_udp else None)
        return (
            *(PROGRAM, "-c", scene.link(self.receiver, self.over).address, "-p", str(self.port)),
            *(("-u", "-l", str(self.payload_bytes)) if is_udp else ()),
            *(() if is_udp or not rate else ("-l", str(_BLOCK_BYTES))),
            *(("-b", str(round(rate))) if rate else ()),
            *(("-P", str(self.streams)) if self.streams > 1 else ()),
            *options,
        )

    def interval_s(self, protocol: Protocol) -> float:
        """Return the time between two blocks or datagrams of a stream; 0 without a rate limit."""
        is_udp = self.transport_protocol(protocol) is Protocol.UDP
        if self.rate is None and not is_udp:
            return 0.0
        return 8 * (self.payload_bytes if is_udp else _BLOCK_BYTES) / (self.rate or DEFAULT_UDP_BIT_S)

    def data_streams(
        self,
        scene: Scene,
        *,
        reverse: bool = False,
        ports: tuple[tuple[int, int], ...] = (),
        duration_s: float | None = None,
        receiver_end_ns: int | None = None,
    ) -> LoadStreams:
        """Return the packet filter of the load's data streams in captures.

        Args:
            scene: The attempt.
            reverse: Whether the server sends.
            ports: Ports of the streams; see `LoadStreams.ports`.
            duration_s: Duration of the load; see `FlowSchedule.duration_s`.
            receiver_end_ns: Time at which the receiver stopped; see `FlowSchedule.receiver_end_ns`.
        """
        ends = [scene.link(role, self.over).address for role in (self.sender, self.receiver)]
        source, destination = reversed(ends) if reverse else ends
        transport = self.transport_protocol(scene.protocol)
        return LoadStreams(
            protocol=transport,
            source_address=source,
            destination_address=destination,
            port=self.port,
            source_listens=reverse,
            count=self.streams,
            payload_bytes=self.payload_bytes,
            ports=ports,
            schedule=FlowSchedule(
                interval_s=self.interval_s(scene.protocol),
                # A TCP stream from the client starts with iperf3's cookie.
                head_bytes=0 if reverse or transport is Protocol.UDP else COOKIE_BYTES,
                duration_s=duration_s,
                receiver_end_ns=receiver_end_ns,
            ),
        )

    def expected_bit_s(self, protocol: Protocol) -> float:
        """Return the approximate rate of the load in repeats of a protocol, in bits per second."""
        if self.rate is None and self.transport_protocol(protocol) is Protocol.TCP:
            return GOOD_BIT_S
        return self.streams * (self.rate or DEFAULT_UDP_BIT_S)

    def flow(self, protocol: Protocol, size_bytes: float) -> Flow:
        """Return the traffic of `size_bytes` of the load on the radio, in repeats of a protocol."""
        transport = self.transport_protocol(protocol)
        frame_count = frames(transport, size_bytes, self.payload_bytes)
        return Flow(self.sender, self.receiver, self.port, frame_count, transport, link=self.over)
