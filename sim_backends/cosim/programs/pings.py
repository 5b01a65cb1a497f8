"""Programs that send ping requests, and programs that reply to them."""

from collections.abc import Sequence
from dataclasses import dataclass

from sim_backends.cosim.federates import Action
from sim_backends.network.packets import Datagram, Received
from sim_backends.world.motion import State

REPLY = "/reply"
"""Suffix of the name of the flow of replies."""


@dataclass(frozen=True, slots=True)
class PingRequest:
    """The payload of a request.

    Attributes:
        flow: Its flow.
        number: Its number in the flow.
        size_bytes: Size of the request and of its reply.
        protocol: Transport of both.
    """

    flow: str
    number: int
    size_bytes: int
    protocol: str


class EchoRequester:
    """Sends requests at a constant rate.

    Args:
        flow: Name of the flow.
        destination: Name of the agent that replies.
        count: Number of requests.
        interval_ns: Time between requests.
        size_bytes: Size of each request.
        first_ns: Time of the first request.
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
        """Return the time of the next request, or None after the last."""
        return self._next_ns if self._sent < self._count else None

    def wake(self, now_ns: int, own_state: State, received: Sequence[Received]) -> Action:  # noqa: ARG002 (Program)
        """Send a request if it is due."""
        wake_ns = self.next_wake_ns()
        if wake_ns is None or now_ns < wake_ns:
            return Action()
        request = PingRequest(self._flow, self._sent, self._size_bytes, self._protocol)
        self._sent += 1
        self._next_ns += self._interval_ns * ((now_ns - wake_ns) // self._interval_ns + 1)
        return Action(
            (Datagram(self._destination, self._size_bytes, self._flow, request.number, request, self._protocol),)
        )


class EchoResponder:
    """Replies to every request immediately."""

    def next_wake_ns(self) -> None:
        """Return None: it wakes only when a request arrives."""

    def wake(self, now_ns: int, own_state: State, received: Sequence[Received]) -> Action:  # noqa: ARG002 (Program)
        """Send a reply to each received request."""
        requests = [
            (datagram.source, datagram.payload) for datagram in received if isinstance(datagram.payload, PingRequest)
        ]
        return Action(
            [
                Datagram(source, request.size_bytes, request.flow + REPLY, request.number, None, request.protocol)
                for source, request in requests
            ]
        )
