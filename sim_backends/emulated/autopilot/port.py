"""The MAVLink port of the autopilot, with a router in front: one stream of frames, several clients.

Sequence numbers and message rates are those of the port. As mavlink-router does, a frame with a target goes only to
the clients that have sent frames of this system and component: others see a gap in the sequence numbers.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final

from sim_backends.emulated.autopilot import mavlink
from sim_backends.emulated.autopilot.mavlink import Message

MOST_CLIENTS: Final = 16
SILENT_NS: Final = 15_000_000_000
"""A client that sends nothing for this long is removed."""

Address = tuple[str, int]
"""Address and UDP port of a client."""
Frame = tuple[Address, bytes]
"""Receiver, and frame."""


@dataclass
class _Client:
    """A client: when it was heard, and the systems and components whose frames it sent."""

    heard_ns: int
    senders: set[tuple[int, int]] = field(default_factory=set)

    def wants(self, system: int, component: int) -> bool:
        """Return whether a frame with this target is for it; 0 is a broadcast."""
        if not system:
            return True
        return any(system == known and component in {0, part} for known, part in self.senders)


_MOST_SENDERS: Final = 64
"""Systems and components that are remembered for a client."""


class MavlinkPort:
    """One port.

    Args:
        system: System id of the autopilot.
    """

    def __init__(self, system: int) -> None:
        self._writer = mavlink.Writer(system)
        self._clients: dict[Address, _Client] = {}

    def identify(self, system: int) -> None:
        """Send with another system id from now on."""
        self._writer = mavlink.Writer(system)

    @property
    def is_used(self) -> bool:
        """Whether there is a client."""
        return bool(self._clients)

    def heard(self, sender: Address, message: Message, now_ns: int) -> bool:
        """Note a message of a client; return whether the client is served: at most `MOST_CLIENTS` are."""
        client = self._clients.get(sender)
        if client is None:
            if len(self._clients) == MOST_CLIENTS:
                return False
            client = self._clients[sender] = _Client(now_ns)
        client.heard_ns = now_ns
        if len(client.senders) < _MOST_SENDERS:
            client.senders.add((message.get_srcSystem(), message.get_srcComponent()))
        return True

    def expire(self, now_ns: int) -> None:
        """Remove silent clients."""
        self._clients = {at: client for at, client in self._clients.items() if now_ns - client.heard_ns < SILENT_NS}

    def frames(self, messages: Iterable[Message]) -> Iterator[Frame]:
        """Yield messages as frames, each for the clients that receive it."""
        for message in messages:
            frame = self._writer.frame(message)
            target = mavlink.addressee(message)
            for address, client in self._clients.items():
                if client.wants(*target):
                    yield address, frame
