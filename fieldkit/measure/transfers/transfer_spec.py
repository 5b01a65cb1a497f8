"""A transfer under test: the addresses, port and files that identify its packets."""

from dataclasses import dataclass
from typing import Final

from fieldkit.core.model import Protocol, Role
from fieldkit.measure.captures.arrays import NO_TIME, Ints, Mask
from fieldkit.measure.captures.headers import TCP, UDP
from fieldkit.measure.captures.packets import Packets

_IP_PROTOCOL: Final = {Protocol.TCP: TCP, Protocol.UDP: UDP}


@dataclass(frozen=True)
class Transfer:
    """One transfer of one file.

    Attributes:
        protocol: Transport protocol.
        source: Role of the sending robot.
        destination: Role of the receiving robot.
        sender_address: Address of the sender on the link under test.
        receiver_address: Address of the receiver on the link under test.
        port: Port that the receiver listens on.
        sent_file: Name of the sent file in the attempt's folder.
        received_file: Name of the file that the listener, the receiving program, wrote in the same folder.
        captures: Names of the sender's and the receiver's capture in the same folder; None without a capture.
        name: Name of the step, which is the prefix of the transfer's other files; empty if the step has no name.
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
        """True if both ends are captured; the files can be missing nevertheless."""
        return None not in self.captures

    def forward(self, packets: Packets) -> Packets:
        """Return the packets of the transfer's protocol from sender to receiver, with any ports."""
        return packets.where(
            packets.are_from(self.sender_address)
            & packets.are_to(self.receiver_address)
            & (packets.protocol == _IP_PROTOCOL[self.protocol])
        )

    def backward(self, packets: Packets) -> Packets:
        """Return the packets of the transfer's protocol from receiver to sender, with any ports."""
        return packets.where(
            packets.are_from(self.receiver_address)
            & packets.are_to(self.sender_address)
            & (packets.protocol == _IP_PROTOCOL[self.protocol])
        )


def span_s(time_ns: Ints, carries_payload: Mask) -> float | None:
    """Return the time in seconds from the first frame to the last frame with payload.

    Return None if no frame has payload, or if a frame has no time.
    """
    if not carries_payload.any() or (time_ns == NO_TIME).any():
        return None
    return float(time_ns[carries_payload].max() - time_ns.min()) / 1e9
