"""MAVLink port of the autopilot behind a router: one stream of frames for several clients.

Sequence numbers and message rates are those of the port. As in mavlink-router, a frame with a target goes only to the
clients that have sent frames of this system and component, so that other clients see gaps in the sequence numbers.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final

from sim_backends.emulated.autopilot import mavlink
from sim_backends.emulated.autopilot.mavlink import Message

MAX_CLIENTS: Final = 16
SILENT_NS: Final = 15_000_000_000
"""A client that sends nothing for this long is removed."""

Address = tuple[str, int]
"""Address and UDP port of a client."""
Frame = tuple[Address, bytes]
"""Address of the receiver, and the frame."""


@dataclass
class _Client:
    """A client: time of its last message, and the systems and components whose frames it has sent."""

    received_ns: int
    senders: set[tuple[int, int]] = field(default_factory=set)

    def is_addressed(self, system: int, component: int) -> bool:
        """Return True if a frame with this target is for the client; 0 is a broadcast."""
        if not system:
            return True
        return any(system == sender and component in {0, part} for sender, part in self.senders)


_MAX_SENDERS: Final = 64
"""Maximum number of systems and components that are stored for a client."""


class MavlinkPort:
    """One port with its clients.

    Args:
        system: System id of the autopilot.
    """

    def __init__(self, system: int) -> None:
        self._writer = mavlink.Writer(system)
        self._clients: dict[Address, _Client] = {}

    def identify(self, system: int) -> None:
        """Use another system id from now on."""
        self._writer = mavlink.Writer(system)

    @property
    def is_used(self) -> bool:
        """True if there is a client."""
        return bool(self._clients)

    def register(self, sender: Address, message: Message, now_ns: int) -> bool:
        """Register a message of a client; return False if there are `MAX_CLIENTS` others, so that it is ignored."""
        client = self._clients.get(sender)
        if client is None:
            if len(self._clients) == MAX_CLIENTS:
                return False
            client = self._clients[sender] = _Client(now_ns)
        client.received_ns = now_ns
        if len(client.senders) < _MAX_SENDERS:
            client.senders.add((message.get_srcSystem(), message.get_srcComponent()))
        return True

    def expire(self, now_ns: int) -> None:
        """Remove silent clients."""
        self._clients = {
            at: client for at, client in self._clients.items() if now_ns - client.received_ns < SILENT_NS
        }

    def frames(self, messages: Iterable[Message]) -> Iterator[Frame]:
        """Yield each message as a frame, once per client that receives it."""
        for message in messages:
            frame = self._writer.frame(message)
            target = mavlink.addressee(message)
            for address, client in self._clients.items():
                if client.is_addressed(*target):
                    yield address, frame
