"""Programs that ask, and programs that answer."""

from collections.abc import Sequence
from dataclasses import dataclass

from sim_backends.cosim.federates import Action
from sim_backends.network.packets import Datagram, Received
from sim_backends.world.motion import State

REPLY = "/reply"
"""What is added to a flow's name for that of its answers."""


@dataclass(frozen=True, slots=True)
class PingRequest:
    """What a request says.

    Attributes:
        flow: Its flow.
        number: Which it is of it.
        size_bytes: How large it is, and its answer has to be.
        protocol: What carries both.
    """

    flow: str
    number: int
    size_bytes: int
    protocol: str


class EchoRequester:
    """Asks at a constant rate.

    Args:
        flow: Name of the flow.
        destination: Whom it asks.
        count: How many requests.
        interval_ns: From one to the next.
        size_bytes: Of each.
        first_ns: When the first is sent.
        protocol: Name of the transport.
    """

    def __init__(
        self,
        flow: str,
        destination: str,
        *,
        count: int,
        interval_ns: int,
        size_bytes: int = 56,
        first_ns: int = 0,
        protocol: str = "udp",
    ) -> None:
        self._flow = flow
        self._destination = destination
        self._count = count
        self._interval_ns = interval_ns
        self._size_bytes = size_bytes
        self._next_ns = first_ns
        self._protocol = protocol
        self._sent = 0

    def next_wake_ns(self) -> int | None:
        """See `Program.next_wake_ns`."""
        return self._next_ns if self._sent < self._count else None

    def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:  # noqa: ARG002 (see Program)
        """See `Program.wake`."""
        wake_ns = self.next_wake_ns()
        if wake_ns is None or now_ns < wake_ns:
            return Action()
        request = PingRequest(self._flow, self._sent, self._size_bytes, self._protocol)
        self._sent += 1
        self._next_ns += self._interval_ns * ((now_ns - wake_ns) // self._interval_ns + 1)
        return Action(
            (Datagram(self._destination, self._size_bytes, self._flow, request.number, request, self._protocol),)
        )


class PingAnswers:
    """Answers every request at once."""

    def next_wake_ns(self) -> None:
        """See `Program.next_wake_ns`."""

    def wake(self, now_ns: int, own: State, received: Sequence[Received]) -> Action:  # noqa: ARG002 (see Program)
        """See `Program.wake`."""
        requests = [(one.source, one.payload) for one in received if isinstance(one.payload, PingRequest)]
        return Action(
            [
                Datagram(source, one.size_bytes, one.flow + REPLY, one.number, None, one.protocol)
                for source, one in requests
            ]
        )
