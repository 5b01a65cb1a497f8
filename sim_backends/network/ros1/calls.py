"""Calls between nodes and their master by XML-RPC: requests and responses over TCP, with retries."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from sim_backends.network.ros1.streams import TcpStreams
from sim_backends.network.wire import Wire


@dataclass(frozen=True, slots=True)
class CallAnswer:
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
        serve: Callable[[], CallAnswer],
        retry: CallRetry | None,
        *,
        about: str = "",
    ) -> None:
        """Call from one host to another.

        Args:
            caller: The calling host.
            callee: The called host.
            size_bytes: Size of the request.
            serve: Executes the call at the callee and returns the response; a call that is repeated may be executed
                twice.
            retry: Times of retries; None for no retry.
            about: Topic of the call if it has a separate connection, else empty.
        """
        connection = f"xmlrpc {caller} {callee} {about}".rstrip()

        def on_lost(reason: str) -> None:  # noqa: ARG001 (see Lost)
            if retry is not None:
                next_retry = CallRetry(min(2 * retry.first_ns, retry.longest_ns), retry.longest_ns)
                call_again = partial(self.call, caller, callee, size_bytes, serve, next_retry, about=about)
                self._wire.at(self._wire.now_ns + retry.first_ns, caller, call_again)

        def on_request() -> None:
            answer = serve()
            self._streams.send(
                (callee, caller), connection, answer.size_bytes, answer.on_received, on_lost, reverse=True
            )

        self._streams.send((caller, callee), connection, size_bytes, on_request, on_lost)
