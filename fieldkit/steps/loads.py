"""Loads that iperf3 makes between two robots: what they are in a procedure, and what is typed for them.

Of options, those that every version from 3.1 on knows.
"""

from typing import Annotated, Final

from fieldkit.config import schema
from fieldkit.config.schema import Bits, Field, Int, Strict
from fieldkit.core.model import Protocol, Role
from fieldkit.steps.scene import GOOD_BIT_S, Flow, Scene, frames

PROGRAM: Final = "iperf3"

DEFAULT_UDP_BIT_S: Final = 1e6
"""iperf3's own."""

_BLOCK_BYTES: Final = 8192
"""Of TCP at a rate: of iperf3's own, 128 KiB, 2 Mbit/s would be two bursts a second."""


class LoadOptions(Strict):
    """A load from one robot to another.

    Attributes:
        sender: Who runs the client (`from`), and sends.
        receiver: Who runs the server (`to`), and receives.
        protocol: Transport protocol; None for the repeat's.
        rate: What each stream sends per second at most; None for 1 Mbit/s of UDP, and as much as goes of TCP.
        streams: How many at once.
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
            raise schema.complaint(f"{self.sender} cannot send to itself; name another robot", "to")
        return self

    def carried_by(self, protocol: Protocol) -> Protocol:
        """Return what carries the load in repeats of a protocol."""
        return self.protocol or protocol

    def server(self, *options: str) -> tuple[str, ...]:
        """Return the command that serves one test."""
        return (PROGRAM, "-s", "-1", "-p", str(self.port), *options)

    def client(self, scene: Scene, *options: str) -> tuple[str, ...]:
        """Return the command that sends the load."""
        udp = self.carried_by(scene.protocol) is Protocol.UDP
        rate = self.rate or (DEFAULT_UDP_BIT_S if udp else None)
        return (
            *(PROGRAM, "-c", scene.robot(self.receiver).address, "-p", str(self.port)),
            *(("-u", "-l", str(self.payload_bytes)) if udp else ()),
            *(() if udp or not rate else ("-l", str(_BLOCK_BYTES))),
            *(("-b", str(round(rate))) if rate else ()),
            *(("-P", str(self.streams)) if self.streams > 1 else ()),
            *options,
        )

    def expected_bit_s(self, protocol: Protocol) -> float:
        """Return about how much the load is, in bits per second, in repeats of a protocol."""
        if self.rate is None and self.carried_by(protocol) is Protocol.TCP:
            return GOOD_BIT_S
        return self.streams * (self.rate or DEFAULT_UDP_BIT_S)

    def flow(self, protocol: Protocol, size_bytes: float) -> Flow:
        """Return the load as packets on the radio, of so many bytes, in repeats of a protocol."""
        carrier = self.carried_by(protocol)
        sent = frames(carrier, size_bytes, self.payload_bytes)
        return Flow(self.sender, self.receiver, self.port, sent, carrier)
