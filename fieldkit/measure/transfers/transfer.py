"""A transfer under test: addresses, port and files, which tell its packets from all others."""

from dataclasses import dataclass
from typing import Final

from fieldkit.core.model import Protocol, Role
from fieldkit.measure.captures.arrays import NO_TIME, Ints, Mask
from fieldkit.measure.captures.ip import TCP, UDP
from fieldkit.measure.captures.packets import Packets

_IP_PROTOCOL: Final = {Protocol.TCP: TCP, Protocol.UDP: UDP}


@dataclass(frozen=True)
class Transfer:
    """One transfer of one file.

    Attributes:
        protocol: Transport protocol.
        source: Role of the robot that sends.
        destination: Role of the one that receives.
        sender_address: Address of the sender on the link under test.
        receiver_address: Address of the receiver on it.
        port: Port that the receiver listens on.
        sent_file: Name of the sent file in the attempt's folder.
        received_file: Name of the file there that the listener wrote.
        captures: Names of the files there of what sender and receiver captured meanwhile; None of who did not.
        name: Name of its step, which the names of other files that belong to it begin with; empty without one.
    """

    protocol: Protocol
    source: Role
    destination: Role
    sender_address: str
    receiver_address: str
    port: int
    sent_file: str
    received_file: str
    captures: tuple[str | None, str | None] = (None, None)
    name: str = ""

    @property
    def captured(self) -> bool:
        """Whether both ends captured."""
        return None not in self.captures

    def forward(self, packets: Packets) -> Packets:
        """Return the packets of the protocol that go from sender to receiver, of any port."""
        return packets.where(
            packets.are_from(self.sender_address)
            & packets.are_to(self.receiver_address)
            & (packets.protocol == _IP_PROTOCOL[self.protocol])
        )

    def backward(self, packets: Packets) -> Packets:
        """Return the packets of the protocol that go from receiver to sender, of any port."""
        return packets.where(
            packets.are_from(self.receiver_address)
            & packets.are_to(self.sender_address)
            & (packets.protocol == _IP_PROTOCOL[self.protocol])
        )


def span_s(time_ns: Ints, carries_payload: Mask) -> float | None:
    """Return seconds from the first frame to the last with payload; None when none has any, or times are missing."""
    if not carries_payload.any() or (time_ns == NO_TIME).any():
        return None
    return float(time_ns[carries_payload].max() - time_ns.min()) / 1e9
